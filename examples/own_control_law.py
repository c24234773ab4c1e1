"""Your own control law, beside the paper's: how fast does each drive back, and is the loop stable?

A law is a function of the tracking error and of the reference's speeds; its further arguments are its gains, each with
a default. This one limits the correction of the speed smoothly, so that a large error does not call for 125 m/s.
"""

import argparse
import math
from pathlib import Path
from typing import Annotated

import numpy as np
from matplotlib.figure import Figure

import agv_ncs
from agv_ncs import Quantity

OUTAGES = Path(__file__).parents[1] / "config/outages.yaml"


def gentle(
    x_e: float,
    y_e: float,
    theta_e: float,
    v_r: float,
    w_r: float,
    kx: Annotated[float, Quantity("gain of the error along the track", unit="1/s", low=0.0, high=1e3)] = 25.0,
    ky: Annotated[float, Quantity("gain of the error across the track", unit="1/m^2", low=0.0, high=1e3)] = 1.0,
    ktheta: Annotated[float, Quantity("gain of the error of heading", unit="1/m", low=0.0, high=1e3)] = 2.0,
    most: Annotated[float, Quantity("limit on the correction of the speed", unit="m/s", above=0.0, high=1e3)] = 2.0,
) -> tuple[float, float]:
    """Kanayama's law with the correction k_x x_e replaced by most tanh(k_x x_e / most): v [m/s], w [rad/s]."""
    v = v_r * math.cos(theta_e) + most * math.tanh(kx * x_e / most)
    return v, w_r + v_r * (ky * y_e + ktheta * math.sin(theta_e))


def main(out: Path) -> None:
    """Drive ten seconds with each law under the same outages, and draw the distance from the reference."""
    agv_ncs.register_control_law("gentle", gentle)
    axes = (figure := Figure(layout="constrained")).add_subplot(xlabel="time [s]", ylabel="distance [m]", yscale="log")
    for law in ("kanayama", "gentle"):
        run = agv_ncs.simulate(agv_ncs.load_scenario(OUTAGES, [f"controller.law={law}", "plant.duration=10.0"]))
        analysis = agv_ncs.analyse(run)
        distance = np.hypot(*(run.reference[:, :2] - run.pose[:, :2]).T)
        print(
            f"{law}: speed up to {np.abs(run.command[:, 0]).max():.1f} m/s, within 20 cm after "
            f"{run.time[np.flatnonzero(distance > 0.2)[-1]]:.2f} s, verdict {analysis.verdict.word}"
        )
        axes.plot(run.time, distance, label=law)
    axes.legend()
    figure.savefig(out / "own_control_law.png")
    print(f"figure: {out / 'own_control_law.png'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(), help="directory for the figure")
    main(parser.parse_args().out)
