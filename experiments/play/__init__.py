"""Play with the world model in a browser: `textocvp play`, or `python -m experiments.play` from the source."""
