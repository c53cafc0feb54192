"""pyTomoAO on its own KAPA configuration, in a Python that has it: ``python rival_pytomoao.py OUT.npz``.

Its reconstructor and its fit to the mirror's commands, as its documentation builds them, with their times; its own
warm-up (compilation, done when it is imported) is not counted.
"""

import json
import sys
import time
from importlib.metadata import version
from importlib.resources import files

import numpy as np
import yaml
from pyTomoAO.reconstructor import tomographicReconstructor

ALPHA = 10.0  # its default: the noise's variance over the mean variance of all slopes
TURNS = 5


def main() -> None:
    """Build and save."""
    path = files("pyTomoAO") / "data" / "tomography_config_kapa.yaml"
    building, fitting = [], []
    for _ in range(TURNS):
        rival = tomographicReconstructor(str(path), force_cpu=True)
        start = time.perf_counter()
        rival.build_reconstructor(alpha=ALPHA)
        built = time.perf_counter()
        rival.assemble_reconstructor_and_fitting(nChannels=4)
        building.append(built - start)
        fitting.append(time.perf_counter() - built)
    np.savez(
        sys.argv[1],
        version=version("pyTomoAO"),
        configuration=json.dumps(yaml.safe_load(path.read_text())),
        alpha=ALPHA,
        reconstructor=rival.RecStatSA,
        grid=rival.gridMask,
        commands=len(rival.FR),
        building=building,
        fitting=fitting,
    )


if __name__ == "__main__":
    main()
