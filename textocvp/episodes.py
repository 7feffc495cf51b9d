"""The episode file by its name before the move; it lives in `textocvp.data.episodes`."""

from textocvp.data.episodes import EpisodeFile as EpisodeFile
