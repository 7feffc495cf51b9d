"""The evaluation protocol that the studies share: scenes, the predicted study, the closed loop, pictures.

Every unit of work is one small frozen dataclass with `run(worker)`; it depends on nothing but its own fields
and the checkpoint, so figures do not change with the number of processes.
"""
