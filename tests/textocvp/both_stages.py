"""Both stages of training on toy episodes, for tests that compare one process with several.

accelerate launch --cpu --num_processes 2 -m tests.textocvp.both_stages FOLDER NAME
"""

from __future__ import annotations

import sys
from pathlib import Path

from tests.textocvp.conftest import PLACED, PUBLISHED, build
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp import cli, training
from textocvp.config import PRESETS

STEPS = 3
RUNS = {
    "parser, drawn first slots": ["parser", "--preset", PUBLISHED.name],
    "parser, clusters, in parts": ["parser", "--preset", PLACED.name, "--accumulate", "2"],
    "parser, single frames": ["parser", "--preset", PLACED.name, "--clip", "1"],
    "predictor, causal, image loss": ["predictor", "--parser", PLACED.name, "--image-weight", "1.0"],
    "predictor, window": ["predictor", "--parser", PUBLISHED.name],
}


def write_inputs(folder: Path) -> None:
    """Toy episodes and a checkpoint of each family."""
    write_toy_episodes(folder / "train.h5", [9, 8, 9, 9, 7])
    write_toy_episodes(folder / "val.h5", [9, 8], seed=1)
    for config in (PLACED, PUBLISHED):
        build(config).save_pretrained(folder / config.name)


def main(folder: Path, name: str) -> None:
    """Do every run of `RUNS` into `folder`/`name`, with the command that people use."""
    PRESETS.update({config.name: config for config in (PLACED, PUBLISHED)})
    training.LOG_EVERY = 1
    for run, command in RUNS.items():
        if command[0] == "predictor":
            command = [*command[:2], str(folder / command[2]), *command[3:], "--horizon", "2"]
        files = ["--data", folder / "train.h5", "--val", folder / "val.h5", "--out", folder / name / run]
        lengths = ["--steps", str(STEPS), "--batch", "5", "--warmup", "1"]
        status = cli.main(["train", *command, *map(str, files), *lengths])
        if status:
            sys.exit(status)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
