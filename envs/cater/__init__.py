"""CATER-hard, the paper's second world: a table without a robot, on which two things act at once."""

from .captions import read_caption
from .record import CaterConfig
from .scenes import ACTIONS, Act, Action, Clip, Thing, cell, draw_acts, draw_clip
from .world import Table
