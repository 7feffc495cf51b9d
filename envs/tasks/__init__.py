"""What may be asked for on the tabletop: one file a task, one line here."""

from .base import Question, Relation, Task
from .put_in_bowl import In
from .rearrange import Rearrange

TASKS: dict[str, Task] = {
    "put_block_in_bowl": Task((In(),)),
    "put_blocks_in_bowls": Task((In(),), pairs=(2, 3)),
    "rearrange_blocks": Rearrange(),
}
