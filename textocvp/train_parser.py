"""Stage 1: train the parser and the renderer to redraw short clips.

    textocvp train parser --data data/tabletop-train.h5 --val data/tabletop-val.h5 --out runs/parser

No label is used: the loss compares the drawn frame with the frame, the drawn masks with the parser's own attention,
and the places that the transition expected with those that the corrector found.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import imageio.v3 as iio
import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm
from transformers import get_cosine_schedule_with_warmup

from textocvp.config import preset, with_settings
from textocvp.drawing import color_masks
from textocvp.episodes import EpisodeFile
from textocvp.losses import ParserLoss, image_loss, mask_loss, place_loss, read_place_loss, thing_weights
from textocvp.model import TextOCVP
from textocvp.parser import to_frames
from textocvp.parser_quality import ParserQuality, measure_parser
from textocvp.slots import SlotState
from textocvp.training import load_state, save_state, start, step_rng


@dataclass
class ParserTraining:
    """Train the scene parser and the renderer (stage 1)."""

    data: Path
    """Training episodes, from `python -m envs.collect --split train`."""
    val: Path
    """Held-out episodes, for the quality figures."""
    out: Path
    """Folder of the run. If it holds an unfinished run, that run goes on."""
    preset: str = "tabletop-small"
    """Architecture; `textocvp info` lists the presets."""
    set: tuple[str, ...] = ()
    """Settings of the preset to change, each part.field=value: `--set parser.initializer=gaussian`."""
    episodes: int | None = 2000
    """Train on the first so many episodes of the file only."""
    steps: int = 2000
    """Updates."""
    batch: int = 16
    """Clips an update."""
    clip: int = 3
    """Frames a clip."""
    stride: int = 2
    """Episode frames between two frames of a clip, drawn from 1 to this."""
    learning_rate: float = 4e-4
    """Peak of the cosine schedule."""
    warmup: int = 300
    """Updates until the peak."""
    clip_norm: float = 1.0
    """Largest gradient norm."""
    thing_weight: float = 4.0
    """How much more a pixel that is not canvas counts."""
    mask_weight: float = 0.1
    """Weight of the agreement between drawn masks and attention."""
    place_weight: float = 0.1
    """Weight of the transition's error in place, or of the error of the places that the renderer reads."""
    precision: Literal["no", "bf16", "fp16"] = "no"
    """Mixed precision."""
    seed: int = 0
    """Seed of weights and data order."""
    evaluate_every: int = 500
    """Updates between quality figures."""
    evaluate_episodes: int = 40
    """Held-out episodes they are measured on; the final figures use all."""
    save_minutes: float = 4.0
    """Minutes between saved states."""


def parser_loss(model: TextOCVP, frames_BT3HW: Tensor, thing_weight: float) -> ParserLoss:
    """The terms of stage 1 for clips in -1..1."""
    parsed = model.parser(frames_BT3HW)
    target = frames_BT3HW.flatten(0, 1)
    slots_NKD, attention_NKHW = parsed.slots_BTKD.flatten(0, 1), parsed.attention_BTKHW.flatten(0, 1)
    rendered = model.renderer(slots_NKD)
    weights = thing_weights(target, thing_weight)
    mask = place = target.new_zeros(())
    places = model.renderer.places(slots_NKD)
    if places is not None:
        place = read_place_loss(*places, attention_NKHW)
    if parsed.expected_BTKD is not None:
        layout = model.config.parser.layout
        mask = mask_loss(rendered, attention_NKHW, weights)
        found = SlotState.split(parsed.slots_BTKD[:, 1:], layout)
        place = place_loss(SlotState.split(parsed.expected_BTKD, layout), found)
    return ParserLoss(image_loss(rendered, target, weights), mask, place)


def train(args: ParserTraining) -> ParserQuality:
    """Run or continue stage 1; writes `out`/checkpoint and returns the final quality on the held-out episodes."""
    accelerator = start(args.out, args.precision)
    torch.manual_seed(args.seed)
    model = TextOCVP(with_settings(preset(args.preset), args.set))
    parameters = [*model.parser.parameters(), *model.renderer.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=args.learning_rate)
    schedule = get_cosine_schedule_with_warmup(optimizer, args.warmup, args.steps)
    model, optimizer, schedule = accelerator.prepare(model, optimizer, schedule)
    first = load_state(accelerator, args.out)

    with EpisodeFile(args.data, first=args.episodes) as episodes, EpisodeFile(args.val) as held_out:
        saved = time.monotonic()
        bar = tqdm(range(first, args.steps), initial=first, total=args.steps, desc="parser", unit="step")
        for step in bar:
            rng = step_rng(args.seed, step, accelerator.process_index)
            stride = int(rng.integers(1, args.stride + 1))
            clips = episodes.random_clips(rng, args.batch, (args.clip - 1) * stride + 1)[:, ::stride]
            frames = to_frames(clips, accelerator.device)
            with accelerator.autocast():
                loss = parser_loss(model, frames, args.thing_weight)
            total = loss.total(args.mask_weight, args.place_weight)
            accelerator.backward(total)
            norm = accelerator.clip_grad_norm_(parameters, args.clip_norm)
            optimizer.step()
            schedule.step()
            optimizer.zero_grad()

            if step % 20 == 0:
                figures = {
                    "loss/total": total.item(),
                    "loss/image": loss.image.item(),
                    "loss/mask": loss.mask.item(),
                    "loss/place": loss.place.item(),
                    "gradient_norm": float(norm),
                }
                accelerator.log(figures, step=step)
                bar.set_postfix(image=f"{loss.image.item():.4f}", mask=f"{loss.mask.item():.4f}")
            if (step + 1) % args.evaluate_every == 0:
                quality = measure_parser(model, held_out, range(min(args.evaluate_episodes, len(held_out))))
                accelerator.log(quality.figures(), step=step)
                tqdm.write(f"step {step + 1}: {quality}")
                draw_samples(model, held_out, range(4), args.out / "samples" / f"{step + 1:06d}.png")
            if time.monotonic() - saved > 60 * args.save_minutes:
                save_state(accelerator, args.out, step + 1)
                saved = time.monotonic()

        save_state(accelerator, args.out, args.steps)
        accelerator.unwrap_model(model).save_pretrained(args.out / "checkpoint")
        quality = measure_parser(model, held_out, range(len(held_out)))
    print(f"final: {quality}")
    for sentence in quality.missed_gates():
        print(f"not good enough to train a predictor on: {sentence}")
    (args.out / "quality.json").write_text(quality.to_json())
    accelerator.end_training()
    return quality


@torch.no_grad()
def draw_samples(
    model: TextOCVP, episodes: EpisodeFile, chosen: Iterable[int], path: Path, columns: int = 8
) -> None:
    """A picture with three rows an episode: frames, frames redrawn from their slots, and the slots' masks."""
    rows = []
    for index in chosen:
        episode = episodes.episode(index)
        times = np.linspace(0, len(episode.frames) - 1, columns).round().astype(int)
        slots = model.parser(to_frames(episode.frames[None])).slots_BTKD[0, times]
        rendered = model.renderer(slots)
        drawn = ((rendered.frames_B3HW.clamp(-1, 1) + 1) * 127.5).permute(0, 2, 3, 1).numpy().astype(np.uint8)
        masks = color_masks(rendered.masks_BKHW.numpy())
        for strip in (episode.frames[times], drawn, masks):
            rows.append(np.concatenate(list(strip), axis=1))
    picture = np.concatenate(rows).repeat(2, 0).repeat(2, 1)
    path.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(path, picture)
