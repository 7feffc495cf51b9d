"""Pictures: those that come in from files, and those that are drawn of rollouts."""

from textocvp.pictures.draw import SUFFIXES, captioned, color_masks, enlarge, save_film, slot_palette
from textocvp.pictures.read import bring_to_size, read_picture
