"""Where the planner's few numbers come from: thresholds, the width of a bowl, and the controller's heights.

    python experiments/calibrate.py --data data/tabletop-val.h5

Everything is measured on the simulator's own masks of the val split, before any prediction was looked at, and frozen
in `planning/` with the printed evidence. The script checks that what is frozen there still meets the bars, and ends
with an error if it does not. It never writes into the code.
"""

import sys
from collections.abc import Iterable, Sequence
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

from envs import Expert
from envs.colors import palette
from planning import (
    RELATIONS,
    THRESHOLDS,
    Controller,
    Instruction,
    Palette,
    PinholeCamera,
    Thing,
    Trace,
    measure,
    succeeds,
)
from planning.grounding import BOWL_WIDTH, apparent_width, color_distance
from planning.masks import centroids
from textocvp.data.episodes import Episode, EpisodeFile

CONSOLE = Console()
LOOKS = Palette.from_info(palette())
COLORS = {**LOOKS.colors, "robot": LOOKS.robot, "table": LOOKS.table}
HEIGHTS = (0.025, 0.03, 0.035, 0.04, 0.045)  # metres, to compare the controller's own with
Floats = NDArray[np.float64]


@dataclass
class Args:
    """Calibrates the planner on simulator masks, and prints the evidence."""

    data: Path = Path("data/tabletop-val.h5")
    """Episodes of the val split."""
    precision_scenes: int = 100
    """Scenes, of val seeds, that are played in PyBullet to measure the controller's precision."""


@dataclass
class Measured:
    """What the masks of successful episodes show."""

    # The arm with the thing and with a target, one trace an (episode, target): its own, and the scene's others.
    own: list[Trace] = field(default_factory=list)
    other: list[Trace] = field(default_factory=list)
    unmoved: list[Trace] = field(default_factory=list)  # the arm with each thing that was not named
    # kind -> apparent widths in metres, in first and last frames
    widths: dict[str, list[float]] = field(default_factory=dict)
    colors: list[bool] = field(default_factory=list)  # whether each was named right

    def add(self, episode: Episode, camera: PinholeCamera) -> None:
        """Measure an episode."""
        played = episode.question(episode.instruction)
        if played is None or episode.segmentation is None or episode.robot is None:
            raise ValueError("the file has no masks, robot or questions: collect the episodes again")
        relation = Instruction.parse(episode.instruction).relation
        labels_THW = torch.from_numpy(episode.segmentation)
        masks = {item.id: labels_THW.eq(item.label)[None] for item in episode.objects}
        arm_1THW, thing_1THW = labels_THW.eq(episode.robot)[None], masks[played.moves]
        for item in episode.objects:
            if item.kind == RELATIONS[relation].kinds[1]:
                trace = measure(arm_1THW, thing_1THW, masks[item.id], [relation])
                (self.own if item.id == played.ends_at else self.other).append(trace)
            elif item.id != played.moves:
                self.unmoved.append(measure(arm_1THW, masks[item.id], masks[item.id], [relation]))
            for t in (0, -1):
                mask_HW = masks[item.id][0, t].numpy()
                self.widths.setdefault(item.kind, []).append(apparent_width(mask_HW, camera))
                seen_13 = episode.frames[t][mask_HW].mean(0, keepdims=True) / 255
                nearest = min(COLORS, key=lambda name: float(color_distance(seen_13, COLORS[name])[0]))
                self.colors.append(nearest == item.color)


def main(args: Args) -> bool:
    """Print all the evidence; whether every bar is met."""
    torch.set_num_threads(1)
    measured = Measured()
    with EpisodeFile(args.data) as episodes:
        if episodes.split != "val" or episodes.seeds is None:
            raise ValueError(f"calibration belongs to the val split, {args.data} holds {episodes.split!r}")
        views = (episodes.attribute(f"camera_{name}") for name in ("intrinsics", "extrinsics"))
        camera = PinholeCamera(*views)
        for episode in track(episodes, "episodes", total=len(episodes), console=CONSOLE):
            if episode.success:
                measured.add(episode, camera)
        seeds = episodes.seeds[: args.precision_scenes].tolist()
    met = [report_success(measured), report_looks(measured), report_precision(seeds)]
    CONSOLE.print("[green]every bar is met[/]" if all(met) else "[red]a bar is missed[/]")
    return all(met)


def report_success(measured: Measured) -> bool:
    """The success thresholds: who passes, and how much room there is."""
    limits, within = THRESHOLDS, float(measured.own[0].within_B)
    named = {"its own": measured.own, "another target of the scene": measured.other}
    passed, wrongly = (float(np.mean([bool(succeeds(trace)) for trace in its])) for its in named.values())
    shares = (passed, ">= 0.99"), (wrongly, "<= 0.01")
    show(
        f"Success, judged with {limits} and at most {within:g} px to the target",
        ("instruction", "episodes", "pass", "bar"),
        [
            (name, str(len(its)), f"{share:.4f}", bar)
            for (name, its), (share, bar) in zip(named.items(), shares, strict=True)
        ],
    )
    found: dict[str, list[float]] = {}
    for name, its in ("things that are carried", measured.own), ("things that are not", measured.unmoved):
        contacts = [float(trace.longest_contact(limits.contact_px)) for trace in its]
        found[f"frames in a row within {limits.contact_px:g} px: {name}"] = contacts
    for name, its in named.items():
        ends = torch.cat([trace.distance_Bt[0, -limits.settle_frames :] for trace in its])
        found[f"px to target in the last {limits.settle_frames} frames: {name}"] = ends.tolist()
    found["frames that the thing lies there before the end"] = [lying(trace) for trace in measured.own]
    quantiles("What the thresholds part", found)
    return passed >= 0.99 and wrongly <= 0.01


def lying(trace: Trace) -> int:
    """For how many last frames the thing lies at its target."""
    inside_T = (trace.distance_Bt[0] <= trace.within_B[0]).numpy()
    return len(inside_T) if inside_T.all() else int(inside_T[::-1].argmin())


def report_looks(measured: Measured) -> bool:
    """Kinds and colours, told from the true masks."""
    widths, misnamed = measured.widths, measured.colors.count(False)
    quantiles("Apparent width in m", {f"{kind}s": its for kind, its in widths.items()}, digits=3)
    wrong = {kind: float(np.mean((np.array(its) > BOWL_WIDTH) != (kind == "bowl"))) for kind, its in widths.items()}
    shares = " and ".join(f"{share:.4f} of {kind}s" for kind, share in wrong.items())
    CONSOLE.print(f"at {BOWL_WIDTH} m, {shares} are taken for the other kind")
    CONSOLE.print(f"{misnamed} of {len(measured.colors)} colours are misnamed\n")
    return max(wrong.values()) <= 0.01 and misnamed <= 0.01 * len(measured.colors)


def report_precision(seeds: Sequence[int]) -> bool:
    """The controller's pick and place points against the simulator's, from true masks of scenes that are played."""
    env, moved, relation = gym.make("PutBlockInBowl-v0"), [], ""
    for seed in track(seeds, "precision", console=CONSOLE):
        _, info = env.reset(seed=int(seed))
        asked = Instruction.parse(info["instruction"])
        places = [*place_and_centroid(info, asked.thing)]
        for action in Expert(env).actions():
            _, _, _, _, info = env.step(action)
        if info["is_success"]:
            moved.append([*places, *place_and_centroid(info, asked.thing)])
            relation = asked.relation
    camera = PinholeCamera.from_info(info["camera"])
    env.close()
    starts_N2, picks_N2, ends_N2, places_N2 = (np.stack(column) for column in zip(*moved, strict=True))

    def errors(pick_height: float, place_height: float) -> list[Floats]:
        """Distances on the table between where pixels point at a height, and true places: (N,) in mm each."""
        pointed = (picks_N2, starts_N2, pick_height), (places_N2, ends_N2, place_height)
        return [
            1000 * np.linalg.norm(camera.unproject_to_plane(pixels_N2, height)[:, :2] - true_N2, axis=1)
            for pixels_N2, true_N2, height in pointed
        ]

    own = Controller(camera).pick_height, RELATIONS[relation].place_height
    heights = {f"{height:g}": (height, height) for height in HEIGHTS} | {f"ours: {own[0]:g}, {own[1]:g}": own}
    rows = [
        (name, *(f"{f(its):.1f}" for its in errors(*both) for f in (np.median, np.max)))
        for name, both in heights.items()
    ]
    columns = ("height (m)", "pick, median", "pick, largest", "place, median", "place, largest")
    show("Error of the thing's place on the table, in mm", columns, [*rows, ("bar", "", "< 10", "", "< 25")])
    pick, place = errors(*own)
    return bool(pick.max() < 10 and place.max() < 25)


def place_and_centroid(info: dict[str, Any], thing: Thing) -> tuple[Floats, Floats]:
    """The true place (x, y) of a thing in metres, and the centroid of its mask in pixels."""
    item = next(item for item in info["objects"] if Thing(item["color"], item["kind"]) == thing)
    mask_HW = torch.from_numpy(info["segmentation"] == item["label"])
    return np.asarray(item["position"], dtype=np.float64)[:2], centroids(mask_HW).double().numpy()


def quantiles(title: str, rows: dict[str, list[float]], digits: int = 1) -> None:
    """Print quantiles of some measurements."""
    lines = []
    for name, values in rows.items():
        cells = np.quantile(np.asarray(values, dtype=float), (0, 0.01, 0.5, 0.99, 1))
        lines.append((name, str(len(values)), *(f"{cell:.{digits}f}" for cell in cells)))
    show(title, ("", "n", "min", "1 %", "median", "99 %", "max"), lines)


def show(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table."""
    table = Table(*columns, title=title, title_justify="left")
    for row in rows:
        table.add_row(*row)
    CONSOLE.print(table)


if __name__ == "__main__":
    sys.exit(0 if main(tyro.cli(Args)) else 1)
