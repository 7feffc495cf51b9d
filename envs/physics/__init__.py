"""The simulated table in PyBullet: bodies, the arm and its motions, and the camera. It knows no task."""
