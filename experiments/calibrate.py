"""Where the planner's few numbers come from: thresholds, the width of a bowl, and the controller's heights.

    python experiments/calibrate.py --data data/tabletop-val.h5

Everything is measured on the simulator's own masks of the val split, before any prediction was looked at, and
frozen in `planning/` with the printed evidence. The script checks that what is frozen there still meets the
bars, and ends with an error if it does not. It never writes into the code.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

import envs
from planning import (
    THRESHOLDS,
    Controller,
    Judge,
    PinholeCamera,
    Trace,
    arm_block_distance,
    block_bowl_distance,
)
from planning.grounding import BOWL_WIDTH, COLORS, ROBOT_COLOR, TABLE_COLOR, apparent_width, color_distance
from planning.scores import centroids
from textocvp.data.episodes import EpisodeFile

ARM, FIRST_OBJECT = 1, 2  # labels of a segmentation
PALETTE = {**COLORS, "robot": ROBOT_COLOR, "table": TABLE_COLOR}
Floats = NDArray[np.float64]


@dataclass
class Args:
    """Calibrates the planner on simulator masks, and prints the evidence."""

    data: Path = Path("data/tabletop-val.h5")
    """Episodes of the val split."""
    precision_scenes: int = 100
    """Scenes, of val seeds, that are played in PyBullet to measure the controller's precision."""


@dataclass
class Judged:
    """The judgement of successful episodes: for the bowl that the block went to, and for the others.

    Each list has one trace per (episode, bowl); `unmoved` has one per block that the robot was not told to
    move.
    """

    target: list[Trace] = field(default_factory=list)
    other: list[Trace] = field(default_factory=list)
    unmoved: list[Trace] = field(default_factory=list)


@dataclass
class Looks:
    """How things look in first and last frames: apparent widths in metres, and colours named wrongly."""

    block: list[float] = field(default_factory=list)
    bowl: list[float] = field(default_factory=list)
    named: int = 0
    misnamed: int = 0


def main(args: Args) -> bool:
    """Print all the evidence; whether every bar is met."""
    torch.set_num_threads(1)
    console = Console()
    with EpisodeFile(args.data) as episodes:
        if episodes.split != "val" or episodes.seeds is None:
            raise ValueError(f"calibration belongs to the val split, {args.data} holds {episodes.split!r}")
        camera = PinholeCamera(
            episodes.attribute("camera_intrinsics"), episodes.attribute("camera_extrinsics")
        )
        judged, looks = measure_episodes(episodes, camera, console)
        seeds = episodes.seeds[: args.precision_scenes].tolist()
    met = [
        report_success(judged, console),
        report_looks(looks, console),
        report_precision(seeds, console),
    ]
    console.print("[green]every bar is met[/]" if all(met) else "[red]a bar is missed[/]")
    return all(met)


def measure_episodes(episodes: EpisodeFile, camera: PinholeCamera, console: Console) -> tuple[Judged, Looks]:
    """Distances and looks of all successful episodes, from the true segmentation."""
    judged, looks = Judged(), Looks()
    for episode in track(episodes, "episodes", total=len(episodes), console=console):
        if not episode.success:
            continue
        labels_THW = torch.from_numpy(episode.segmentation)
        played = episode.question(episode.instruction)
        if played is None:
            raise ValueError(f"{episodes.path} has no questions: collect the episodes again")
        block, target = played.moves, played.ends_at
        arm_THW, block_THW = labels_THW == ARM, labels_THW == FIRST_OBJECT + block
        frames = tuple(range(len(labels_THW)))
        held_T = arm_block_distance(arm_THW, block_THW)
        for item in episode.objects:
            item_THW = labels_THW == FIRST_OBJECT + item.id
            if item.kind == "bowl":
                trace = Trace(frames, held_T[None], block_bowl_distance(block_THW, item_THW)[None])
                (judged.target if item.id == target else judged.other).append(trace)
            elif item.id != block:
                near_1T = arm_block_distance(arm_THW, item_THW)[None]
                judged.unmoved.append(Trace(frames, near_1T, torch.zeros_like(near_1T)))
            for t in (0, len(frames) - 1):
                look(item.kind, item.color, item_THW[t].numpy(), episode.frames[t], camera, looks)
    return judged, looks


def look(
    kind: str,
    color: str,
    mask_HW: NDArray[np.bool_],
    rgb: NDArray[np.uint8],
    camera: PinholeCamera,
    looks: Looks,
) -> None:
    """Measure one object in one frame."""
    (looks.block if kind == "block" else looks.bowl).append(apparent_width(mask_HW, camera))
    seen_13 = rgb[mask_HW].mean(0, keepdims=True) / 255
    nearest = min(PALETTE, key=lambda name: float(color_distance(seen_13, PALETTE[name])[0]))
    looks.named += 1
    looks.misnamed += nearest != color


def report_success(judged: Judged, console: Console) -> bool:
    """The success thresholds: who passes, and how much room there is."""
    limits, judge = THRESHOLDS, Judge()
    passed = np.mean([bool(judge(trace)) for trace in judged.target])
    wrongly = np.mean([bool(judge(trace)) for trace in judged.other])
    table = Table(title=f"Success, judged with {limits}", title_justify="left")
    for column in ("instruction", "episodes", "pass", "bar"):
        table.add_column(column)
    table.add_row("its own", str(len(judged.target)), f"{passed:.4f}", ">= 0.99")
    table.add_row("another bowl of the scene", str(len(judged.other)), f"{wrongly:.4f}", "<= 0.01")
    console.print(table)

    held = [float(trace.held(limits.arm_block_px)) for trace in judged.target]
    passing = [float(trace.held(limits.arm_block_px)) for trace in judged.unmoved]
    end_own, end_other = (
        [trace.block_bowl_Bt[0, -limits.settle_frames :] for trace in traces]
        for traces in (judged.target, judged.other)
    )
    quantiles(
        "What the thresholds part",
        {
            f"frames in a row within {limits.arm_block_px:g} px: blocks that are carried": held,
            f"frames in a row within {limits.arm_block_px:g} px: blocks that are not": passing,
            f"block to bowl in px, last {limits.settle_frames} frames: its own bowl": torch.cat(
                end_own
            ).numpy(),
            f"block to bowl in px, last {limits.settle_frames} frames: other bowls": torch.cat(
                end_other
            ).numpy(),
            "frames that the block lies there before the end": [lying(trace) for trace in judged.target],
        },
        console,
    )
    return bool(passed >= 0.99 and wrongly <= 0.01)


def lying(trace: Trace) -> int:
    """For how many last frames the block lies in the bowl."""
    inside_T = (trace.block_bowl_Bt[0] <= THRESHOLDS.block_bowl_px).numpy()
    return len(inside_T) if inside_T.all() else int(inside_T[::-1].argmin())


def report_looks(looks: Looks, console: Console) -> bool:
    """Kinds and colours, told from the true masks."""
    quantiles("Apparent width in m", {"blocks": looks.block, "bowls": looks.bowl}, console, digits=3)
    wrong = np.mean(np.array(looks.block) > BOWL_WIDTH), np.mean(np.array(looks.bowl) <= BOWL_WIDTH)
    console.print(
        f"at {BOWL_WIDTH} m, {wrong[0]:.4f} of blocks and {wrong[1]:.4f} of bowls are taken for the other kind; "
        f"{looks.misnamed} of {looks.named} colours are misnamed\n"
    )
    return bool(max(wrong) <= 0.01 and looks.misnamed <= 0.01 * looks.named)


def report_precision(seeds: list[int], console: Console) -> bool:
    """The controller's pick and place points against the simulator's, from true masks."""
    pick_N2, place_N2, starts_N2, ends_N2, camera = played(seeds, console)
    controller = Controller(camera)
    table = Table(title="Error of the block's place on the table, in mm", title_justify="left")
    for column in ("height (m)", "pick, median", "pick, largest", "place, median", "place, largest"):
        table.add_column(column)
    for height in (0.025, 0.03, 0.035, 0.04, 0.045):
        errors = [error(camera, *both, height) for both in ((starts_N2, pick_N2), (ends_N2, place_N2))]
        table.add_row(f"{height:g}", *(f"{f(e) * 1000:.1f}" for e in errors for f in (np.median, np.max)))
    pick = error(camera, starts_N2, pick_N2, controller.pick_height)
    place = error(camera, ends_N2, place_N2, controller.place_height)
    table.add_section()
    table.add_row(
        f"ours: {controller.pick_height:g}, {controller.place_height:g}",
        *(f"{f(e) * 1000:.1f}" for e in (pick, place) for f in (np.median, np.max)),
    )
    table.add_row("bar", "", "< 10", "", "< 25")
    console.print(table)
    return bool(pick.max() < 0.010 and place.max() < 0.025)


def played(seeds: list[int], console: Console) -> tuple[Floats, Floats, Floats, Floats, PinholeCamera]:
    """Play scenes with the expert.

    Returns:
        where the block stands at the start and lies at the end, (x, y) in metres; the centroids of its true
        mask at the start and the end, (x, y) in pixels; the camera.
    """
    env = gym.make("PutBlockInBowl-v0")
    expert = envs.Expert(env)
    rows: list[list[Floats]] = []
    for seed in track(seeds, "precision", console=console):
        _, info = env.reset(seed=int(seed))
        block = int(info["target"][0][0])
        row = list(place_and_centroid(info, block))
        for action in expert.actions():
            _, _, _, _, info = env.step(action)
        if info["is_success"]:
            rows.append(row + list(place_and_centroid(info, block)))
    camera = PinholeCamera.from_info(info["camera"])
    env.close()
    pick_N2, starts_N2, place_N2, ends_N2 = (np.stack(column) for column in zip(*rows, strict=True))
    return pick_N2, place_N2, starts_N2, ends_N2, camera


def place_and_centroid(info: dict[str, Any], block: int) -> Iterator[Floats]:
    """The block's true place (x, y) in metres and its mask's centroid in pixels."""
    yield np.asarray(info["objects"][block]["position"], dtype=np.float64)[:2]
    yield centroids(torch.from_numpy(info["segmentation"] == FIRST_OBJECT + block)).double().numpy()


def error(camera: PinholeCamera, pixels_N2: Floats, places_N2: Floats, height: float) -> Floats:
    """Distance on the table between where pixels point at a height, and true places: (N,) in metres."""
    return np.linalg.norm(camera.unproject_to_plane(pixels_N2, height)[:, :2] - places_N2, axis=1)


def quantiles(title: str, rows: dict[str, list[float] | Floats], console: Console, digits: int = 1) -> None:
    """Print quantiles of some measurements."""
    table = Table(title=title, title_justify="left")
    for column in ("", "n", "min", "1 %", "median", "99 %", "max"):
        table.add_column(column)
    for name, values in rows.items():
        cells = np.quantile(np.asarray(values, dtype=float), (0, 0.01, 0.5, 0.99, 1))
        table.add_row(name, str(len(values)), *(f"{cell:.{digits}f}" for cell in cells))
    console.print(table)


if __name__ == "__main__":
    sys.exit(0 if main(tyro.cli(Args)) else 1)
