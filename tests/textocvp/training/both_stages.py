"""Every stage of training on toy episodes, for tests that compare one process with several.

torchrun --standalone --nproc_per_node 2 -m tests.textocvp.training.both_stages FOLDER NAME
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

from tests.textocvp.conftest import PLACED, PUBLISHED, SMALL_TEXT, build
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp import cli
from textocvp.baselines.mage import MAGE_PRESETS, MageConfig
from textocvp.baselines.mage.axial import AxialConfig
from textocvp.baselines.mage.vqvae import VQVAEConfig
from textocvp.inputs import OwnFrames
from textocvp.presets import PRESETS
from textocvp.training import run as training

STEPS = 3
OWN = OwnFrames(2, 20.0, 18.0, canvas="2f2f2f", grain=0.1)  # of toy episodes
MAGE = MageConfig(
    name="tiny-mage",
    vqvae=VQVAEConfig(image_size=32, channels=8, blocks=1, codebook_size=16, code_dim=8),
    text=SMALL_TEXT,
    axial=AxialConfig(dim=16, layers=3, heads=2, hidden=16, frames=5),
)
RUNS = {
    "parser, drawn first slots": ["parser", "--preset", PUBLISHED.name],
    "parser, clusters, in parts": ["parser", "--preset", PLACED.name, "--accumulate", "2"],
    "parser, single frames": ["parser", "--preset", PLACED.name, "--clip", "1"],
    "predictor, causal, image loss": ["predictor", "--horizon", "2", "--image-weight", "1.0", "--parser", PLACED.name],
    "predictor, window": ["predictor", "--horizon", "2", "--parser", PUBLISHED.name],
    "restorer": ["restorer", "--parser", PLACED.name],
    "vqvae": ["vqvae", "--preset", MAGE.name, "--restart-every", "1", "--stride", "2"],
    "mage": ["mage", "--preset", MAGE.name, "--vqvae", "vqvae/checkpoint"],
}


def write_inputs(folder: Path) -> None:
    """Toy episodes and a checkpoint of each family."""
    write_toy_episodes(folder / "train.h5", [9, 8, 9, 9, 7])
    write_toy_episodes(folder / "val.h5", [9, 8], seed=1)
    for config in (replace(PLACED, own_frames=OWN), PUBLISHED):
        build(config).save_pretrained(folder / config.name)


def main(folder: Path, name: str) -> None:
    """Do every run of `RUNS` into `folder`/`name`, with the command that people use."""
    tiny = {config.name: config for config in (PLACED, PUBLISHED)}
    with patch.dict(PRESETS, tiny), patch.dict(MAGE_PRESETS, {MAGE.name: MAGE}), patch.object(training, "LOG_EVERY", 1):
        for run, command in RUNS.items():
            inputs = {
                "predictor": folder,
                "restorer": folder,
                "mage": folder / name,
            }  # what the last argument is found in
            if command[0] in inputs:
                command = [*command[:-1], str(inputs[command[0]] / command[-1])]
            files = ["--data", folder / "train.h5", "--val", folder / "val.h5", "--out", folder / name / run]
            lengths = ["--steps", str(STEPS), "--batch", "5", "--warmup", "1"]
            status = cli.main(["train", *command, *map(str, files), *lengths])
            if status:
                sys.exit(status)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
