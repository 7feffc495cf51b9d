"""What `textocvp.data.episodes` was called before there were other data: programs of users say it."""

from textocvp.data.episodes import Episode, EpisodeFile, Episodes
