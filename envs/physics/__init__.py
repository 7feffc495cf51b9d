"""The simulated table in PyBullet: bodies, the arm and its motions, and the camera. It knows no task."""

try:
    import pybullet
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "the environments need PyBullet: pip has it for Python 3.10 and 3.11 on Linux (x86-64), and conda-forge for "
        "the rest: conda install -c conda-forge pybullet",
        name="pybullet",
    ) from error
