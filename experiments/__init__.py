"""The studies, one file each. Run one with `python experiments/NAME.py`; `--help` lists its arguments."""
