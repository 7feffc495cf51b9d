"""Pictures of who listens: attention to the colour words, painted over what is imagined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from experiments.protocol.gallery import pixels
from experiments.protocol.listening import COLOR_WORDS, GROUPS, ROLES, Heard, hear
from experiments.protocol.listening_scenes import ListeningOutcome, Listens, attention_to_words, ends_in_bowl
from experiments.protocol.scenes import TestScene, draw
from experiments.protocol.words import spoken
from experiments.protocol.workers import Worker
from experiments.reporting import Clip, Figure
from experiments.reporting.clips import gif
from experiments.reporting.plots import heat_map
from planning import Instruction, ground_privileged

GLOW = np.array((255, 138, 30), dtype=np.float64)  # what is painted over a slot that listens


@dataclass(frozen=True, eq=False)
class ListeningPictures:
    """A clip, and for the first of each kind a map of slots and words."""

    clip: Clip
    words: Figure | None = None


@dataclass(frozen=True)
class ListeningPicture:
    """A unit of work: draw one case of the study.

    Attributes:
        scene, variants, seed: as `ListeningScene`. variant: which of its texts.
        margin: the figure it was chosen for. success: whether both named things attend most to their colour words.
        rank, best: its place among the best or the worst.
    """

    scene: TestScene
    variants: int
    seed: int
    variant: int
    margin: float
    success: bool
    rank: int
    best: bool

    def run(self, worker: Worker) -> ListeningPictures:
        """Imagine it once more, and paint."""
        model = cast(Listens, worker.world_model)
        drawn = draw(worker.environment(self.scene), self.scene, self.variants)
        text = drawn.texts[self.variant]
        told = Instruction.parse(text)
        parsed = model.parse(drawn.observation["rgb"][None], seed=self.seed)
        truth = ground_privileged(parsed, drawn.info["segmentation"], drawn.info["objects"])[0]
        (attention_TnhKW,), rollout = attention_to_words(model, parsed, [text], self.seed)
        masks_TKHW = rollout.masks[0].cpu().numpy()
        film = pixels(rollout)
        shares_TKW = attention_TnhKW.mean((1, 2))
        panels = [film] + [glow(film, masks_TKHW, shares_TKW[..., word]) for word in COLOR_WORDS]
        kind = "best" if self.best else "worst"
        unfound = "a named thing has no slot"
        clip = Clip(
            name=f"listening-{kind}-{self.rank}.gif",
            gif=gif([panels]),
            panels=("imagined", f'"{told.block}"', f'"{told.bowl}"'),
            title=text,
            caption=f"{self.scene.split.replace('_', ' ')}, seed {self.scene.seed}; "
            + (f"lead {self.margin:.3f}" if np.isfinite(self.margin) else unfound),
            badge=f"{kind} {self.rank}: {'both listen' if self.success else 'missed'}",
            tone="good" if self.success else "bad",
        )
        words = None
        if self.rank == 1:
            present_K = parsed.presence[0, 0].numpy() >= 0.5
            heard = hear(attention_TnhKW, present_K, truth, told, ends_in_bowl(rollout, 0, truth, told))
            words = _words(heard, text, f"words-{kind}.png", kind)
        return ListeningPictures(clip, words)


def glow(film_THW3: np.ndarray, masks_TKHW: np.ndarray, shares_SK: np.ndarray) -> np.ndarray:
    """Frames in faint grey, with each slot as bright as its share of attention to one word.

    Args:
        film_THW3: uint8.
        masks_TKHW: 0..1.
        shares_SK: of the S = T - 1 steps; step s looked at frame s and imagined frame s + 1, over which it is painted.
            The brightest share of the whole film is full.
    """
    shares_TK = np.concatenate([shares_SK[:1], shares_SK])[: len(film_THW3)]
    strength = np.einsum("tkhw,tk->thw", masks_TKHW, shares_TK / max(float(shares_SK.max()), 1e-9))[..., None]
    grey = 0.25 * film_THW3.mean(-1, keepdims=True) + 24
    return (grey * (1 - strength) + GLOW * strength).clip(0, 255).round().astype(np.uint8)


def choose_listening(
    outcomes: Sequence[ListeningOutcome], variants: int, seed: int, count: int
) -> list[ListeningPicture]:
    """The cases with the largest and the smallest lead of the named things, each of another scene.

    Args:
        variants: of the scenes that have any. seed: of the slots. count: of each kind.
    """
    cases = [
        (_lead(heard), bool(heard.most_R.all()), outcome, v)
        for outcome in outcomes
        for v, heard in enumerate(outcome.heard)
    ]
    chosen = []
    for best in (True, False):
        firsts: dict[int, tuple[float, bool, ListeningOutcome, int]] = {}
        for case in sorted(cases, key=lambda case: -case[0] if best else case[0]):
            firsts.setdefault(case[2].scene.seed, case)
        for rank, (lead, success, outcome, v) in enumerate(list(firsts.values())[:count], start=1):
            of = variants if len(outcome.texts) > 1 else 0
            chosen.append(ListeningPicture(outcome.scene, of, seed, v, lead, success, rank, best))
    return chosen


def _lead(heard: Heard) -> float:
    """The smaller of the two leads; a thing without a slot is the worst case there is."""
    return float(heard.margin_R.min()) if not np.isnan(heard.margin_R).any() else -np.inf


def _words(heard: Heard, text: str, name: str, kind: str) -> Figure:
    map_GW = heard.map_nhGW.mean((0, 1))
    there = [g for g in range(len(GROUPS)) if not np.isnan(map_GW[g]).any()]
    told = Instruction.parse(text)
    colors = dict(zip(ROLES, (told.block, told.bowl), strict=True))
    rows = []
    for g in there:
        role = GROUPS[g].removeprefix("named ")
        rows.append(f"{colors[role]} {role}" if role in colors else GROUPS[g])
    caption = f"The {kind} case: mean share over steps, layers and heads."
    return heat_map(
        name, map_GW[there], rows, list(spoken(text)), label="attention to words", caption=caption
    )
