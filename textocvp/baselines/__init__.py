"""Models that TextOCVP is compared with and that are no TextOCVP themselves: one folder each, and the table of them.

A class here is a `textocvp.protocols.VideoModel` with a class method `from_folder(folder, name, device)`.
"""

from typing import Any

from textocvp.baselines.mage import MageVideoModel

BASELINES: dict[str, Any] = {"mage": MageVideoModel}
"""The field `architecture` in the `config.json` of a checkpoint -> the class that loads it."""
