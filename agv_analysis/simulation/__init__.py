"""The loop without ROS: the nodes' scalar functions in one process, as fast as they go.

    loop      one slot of the loop, and whole runs of it, as plain Python on floats
    compiled  the same functions compiled by numba, where it is installed; without it they run as they are, slower
    single    one run of a scenario with its full history
    batch     many runs, of each only its statistics, on all cores
    lanes     up to 16 of them side by side, in vector instructions

Nothing is written twice: what a node computes in a callback is what runs here. A simulated run agrees with a recorded
lockstep run but for the wire, which carries an angle as a quaternion and so loses whole turns and a last digit.
"""

from agv_analysis.simulation.batch import STATISTICS, simulate_batch
from agv_analysis.simulation.single import simulate

__all__ = ["STATISTICS", "simulate", "simulate_batch"]
