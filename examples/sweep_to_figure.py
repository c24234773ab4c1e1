"""A sweep over two parameters: how likely is the loop unstable, by gain and by loss rate?"""

import argparse
from pathlib import Path

import numpy as np

import agv_ncs

PAPER = Path(__file__).parents[1] / "config/paper.yaml"


def main(out: Path) -> None:
    """Simulate ten seeds at each point of the grid, and draw the map with the borders that theory gives."""
    scenario = agv_ncs.load_scenario(PAPER, ["relay.uplink.model=bernoulli", "plant.duration=20.0"])
    vary = {"controller.kx": np.linspace(20.0, 380.0, 19), "relay.uplink.p": np.linspace(0.0, 0.9, 10)}
    found = agv_ncs.sweep(scenario, vary, seeds=10, verdicts=False)  # how the runs fare; a word for each takes longer
    unstable = found["instability"]  # shape (19, 10): one row a gain
    for column, p in enumerate(found.axes["relay.uplink.p"]):
        stable = np.flatnonzero(unstable[:, column] == 0.0)
        gain = f"{found.axes['controller.kx'][stable.max()]:.0f} 1/s" if len(stable) else "none"
        print(f"loss rate {p:.1f}: largest gain whose runs are all stable: {gain}")
    found.draw(out / "sweep.png")
    found.write(out / "sweep.csv")
    print(f"figure: {out / 'sweep.png'}\nrows:   {out / 'sweep.csv'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(), help="directory for the figure and the rows")
    main(parser.parse_args().out)
