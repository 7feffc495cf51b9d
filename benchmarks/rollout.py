"""How fast the world model imagines: 30 candidate instructions x 24 steps over one scene, as a planner asks
for them.

    python benchmarks/rollout.py [--checkpoint tabletop-small] [--threads 2]

Parsed from the picture, imagined, and decoded to masks at the frames that the planner's scorer looks at. Then
one rollout with cached keys and values against the same predictor in the published form, which computes its
window of the last 10 frames again at every step, and against the causal form without a cache. Bars: 1.0 s on
two CPU cores."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import tyro

import envs  # noqa: F401 (registers the environments)
from planning.planners import watched_frames
from planning.thresholds import THRESHOLDS
from textocvp.model import TextOCVP
from textocvp.predictors.textocvp import TextOCVPPredictor
from textocvp.presets import preset
from textocvp.rollout import Rollout
from textocvp.world_model import WorldModel, bundled_checkpoints

COLORS = ("blue", "green", "red", "brown", "cyan", "gray", "yellow")


@dataclass
class Benchmark:
    """Time rollouts of the world model."""

    checkpoint: str = "tabletop-small"
    """Bundled name, folder or hub id; the preset of this name with random weights if it is not bundled."""
    instructions: int = 30
    """Candidates, one batch."""
    steps: int = 24
    """Frames to imagine."""
    threads: int = 2
    """CPU threads."""
    repeats: int = 5
    """Measurements; the median counts."""
    out: Path | None = None
    """Also write the figures here, as JSON."""


@dataclass
class Imagining:
    """Seconds of the predictor alone: with cached keys and values, and computing the past again at every step."""

    cached: float
    recomputed: float
    published_window: float

    def __str__(self) -> str:
        return (
            f"cached {self.cached:.3f}, past recomputed {self.recomputed:.3f} "
            f"({self.recomputed / self.cached:.1f} times), published window of 10 {self.published_window:.3f} "
            f"({self.published_window / self.cached:.1f} times)"
        )


@dataclass
class Figures:
    """Seconds, medians."""

    parse: float
    imagine: float
    decode: float
    total: float
    one: Imagining
    all: Imagining


def median_seconds(
    work: Callable[[Any], object], repeats: int, prepare: Callable[[], Any] = lambda: None
) -> float:
    """After one warm-up; the time of `prepare`, whose result `work` is given, does not count."""
    work(prepare())
    seconds = []
    for _ in range(repeats):
        given = prepare()
        began = time.perf_counter()
        work(given)
        seconds.append(time.perf_counter() - began)
    return float(np.median(seconds))


def load(name: str) -> WorldModel:
    if name in bundled_checkpoints() or Path(name).is_dir() or "/" in name:
        return WorldModel.from_pretrained(name)
    print(f"{name} is not bundled: random weights of the preset")
    torch.manual_seed(0)
    return WorldModel(TextOCVP(preset(name)))


@torch.no_grad()
def measure(args: Benchmark) -> Figures:
    """All figures, in one run."""
    torch.set_num_threads(args.threads)
    world_model = load(args.checkpoint)
    env = gym.make("PutBlockInBowl-v0", image_size=world_model.image_size[0])
    rgb = env.reset(seed=0)[0]["rgb"]
    env.close()
    texts = [f"put the {block} block in the {bowl} bowl" for block, bowl in product(COLORS, COLORS)]
    texts = (texts * args.instructions)[: args.instructions]
    watched = watched_frames(args.steps + 1, THRESHOLDS.settle_frames, stride=3)

    model = world_model.model
    parsed = world_model.parse(rgb[None])
    config = replace(model.config.predictor, attention="window", window=10, age_encoding="learned")
    published = TextOCVPPredictor(config, model.config.parser.layout, model.config.text.dim).eval()
    weights = {name: value for name, value in model.predictor.state_dict().items() if name != "ages"}
    published.load_state_dict(weights, strict=False)

    def imagine(_: object = None) -> Rollout:
        return world_model.rollout(parsed, texts, horizon=args.steps)

    def everything(_: object) -> object:
        scene = world_model.parse(rgb[None])
        return world_model.rollout(scene, texts, horizon=args.steps).decode_masks(watched)

    def imagining(count: int) -> Imagining:
        seed_B1KD, text = parsed.slots.expand(count, -1, -1, -1), model.text(texts[:count])

        def seconds(predictor: TextOCVPPredictor, use_cache: bool) -> float:
            return median_seconds(
                lambda _: predictor.rollout(seed_B1KD, text, args.steps, use_cache=use_cache), args.repeats
            )

        return Imagining(
            cached=seconds(model.predictor, True),
            recomputed=seconds(model.predictor, False),
            published_window=seconds(published, True),
        )

    return Figures(
        parse=median_seconds(lambda _: world_model.parse(rgb[None]), args.repeats),
        imagine=median_seconds(imagine, args.repeats),
        decode=median_seconds(lambda rollout: rollout.decode_masks(watched), args.repeats, prepare=imagine),
        total=median_seconds(everything, args.repeats),
        one=imagining(1),
        all=imagining(args.instructions),
    )


def main(args: Benchmark) -> None:
    """Measure, print, write."""
    figures = measure(args)
    print(
        f"{args.instructions} instructions x {args.steps} steps on {args.threads} threads, seconds (median):"
    )
    print(f"  parse one picture      {figures.parse:8.3f}")
    print(f"  imagine                {figures.imagine:8.3f}")
    print(f"  masks for the scorer   {figures.decode:8.3f}")
    print(f"  all of it              {figures.total:8.3f}   (bar: 1.0)")
    print(f"the predictor alone, {args.steps} steps:")
    print(f"  one rollout            {figures.one}")
    print(f"  {args.instructions} rollouts at once    {figures.all}")
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(asdict(figures), indent=2) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
