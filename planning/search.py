"""Planning by outcomes: search over sentences, where the world model says where each leads.

Every sentence that the scene allows may be said, in any order. Each starts from where the last one was imagined to end.
Nothing here knows what happens when a bowl is full or a block is covered: that is what the model is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from heapq import heappop, heappush
from time import perf_counter
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .camera import View
from .grounding import Grounder, Grounding, GroundingError
from .language import AnyGoal, Goal, Instruction, PictureGoal, Thing
from .planners import Candidate, Imagines, Plan, frames_ahead, observe
from .relations import CLOSE_VIEW, RELATIONS

if TYPE_CHECKING:
    from textocvp.rollout import Rollout

# Two pictures show a thing at one place while it is at most this far apart in them, in pixels of a `View`.
SAME_PLACE_PX = 4.0
# Imagined states in which nothing is farther apart than this, in pixels of a `View`, are one state.
MERGED_PX = 2.0
SHOWN = 100  # candidates that a plan keeps


class Foresees(Imagines, Protocol):
    """All that a search knows of a world model."""

    longest_horizon: int | None  # frames that a film can have

    def outcome(self, obs: Rollout, text: Sequence[str], *, seed: int = 0) -> Rollout:
        """Where n texts lead from one scene (B = 1): n rollouts of two frames, before and after."""


@dataclass(frozen=True, eq=False)
class Wanted:
    """Where G things shall end, each within a distance from a place, or from where another thing is then."""

    thing_G: Tensor  # which of the things that are seen
    target_G: Tensor  # which other one, or -1 where the place is fixed
    offset_G2: Tensor  # from that one in pixels of the view, or from the origin in pixels of the picture
    within_G: Tensor  # pixels of the view
    view: View = CLOSE_VIEW

    def ratios(self, places_BN2: Tensor) -> Tensor:
        """How far things at these places (B, N, 2) are from where they shall be (B, G); up to 1 is near enough."""
        target_BG2, relative_G1 = places_BN2[:, self.target_G], self.target_G[:, None] >= 0
        from_BG2 = torch.where(relative_G1, target_BG2, 0.0)
        raised_BG2 = self.view.raised(self.offset_G2.expand_as(target_BG2), target_BG2)
        offset_BG2 = torch.where(relative_G1, raised_BG2, self.offset_G2)
        limit_BG = self.within_G * self.view.zoom(torch.where(relative_G1, target_BG2, self.offset_G2))
        return (places_BN2[:, self.thing_G] - from_BG2 - offset_BG2).norm(dim=-1) / limit_BG

    @classmethod
    def of_relations(cls, goal: Goal, things: Sequence[Thing], view: View = CLOSE_VIEW) -> Wanted:
        """What the instructions of a goal ask; a GroundingError if a thing is not seen."""
        for thing in goal.things:
            if thing not in things:
                raise GroundingError(f"no {thing} is seen; seen: {', '.join(map(str, things)) or 'nothing'}")
        relations = [RELATIONS[one.relation] for one in goal.instructions]
        return cls(
            torch.tensor([things.index(one.thing) for one in goal.instructions]),
            torch.tensor([things.index(one.target) for one in goal.instructions]),
            torch.tensor([relation.offset_px for relation in relations]),
            torch.tensor([relation.within_px for relation in relations]),
            view,
        )

    @classmethod
    def of_picture(cls, goal: Rollout, shown: Grounding, things: Sequence[Thing]) -> Wanted:
        """Everything as in a parsed picture (B = 1); a GroundingError if it does not show the same things."""
        if set(shown.things) != set(things):
            both = [", ".join(map(str, sorted(ones))) or "nothing" for ones in (shown.things, things)]
            raise GroundingError(f"the goal's picture shows {both[0]}; the scene shows {both[1]}")
        places_N2 = places(goal, shown, things)[0]
        count = len(things)
        limit_N = torch.full((count,), SAME_PLACE_PX)
        return cls(torch.arange(count), torch.full((count,), -1), places_N2, limit_N, shown.view)


def places(rollout: Rollout, grounding: Grounding, things: Sequence[Thing], frame: int = -1) -> Tensor:
    """Where things are in one frame of a batch of rollouts (B, N, 2), in pixels."""
    positions_BK2 = rollout.positions[:, frame].cpu()
    return torch.stack([positions_BK2[:, list(grounding.slots_of(one))].mean(1) for one in things], dim=1)


def seen_supports(
    places_BN2: Tensor, things: Sequence[Thing], view: View = CLOSE_VIEW
) -> list[dict[Thing, Thing | None]]:
    """What each block is seen to be in or on, in B pictures; None for the table.

    Args:
        places_BN2: from `places`, of the N things.
        view: of the grounding.
    """
    seen: list[dict[Thing, Thing | None]] = []
    pairs = places_BN2[:, :, None], places_BN2[:, None]
    off = {one: one.distance_of_places(*pairs, view).tolist() for one in RELATIONS.values()}
    for b in range(len(places_BN2)):
        carried: dict[Thing, Thing | None] = {}
        for n, thing in enumerate(things):
            near: list[tuple[float, Thing | None]] = [(1.0, None)]
            for m, other in enumerate(things):
                for relation, off_BNN in off.items():
                    if n != m and (thing.kind, other.kind) == relation.kinds:
                        near.append((off_BNN[b][n][m] / relation.within_px, other))
            if thing.kind == "block":
                carried[thing] = min(near, key=lambda one: one[0])[1]
        seen.append(carried)
    return seen


@dataclass(frozen=True, eq=False)
class _State:
    """An imagined state, and how it came about."""

    batch: Rollout  # in whose last frame it is
    row: int
    instructions: tuple[Instruction, ...] = ()
    before: _State | None = None
    ratios_G: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))

    @property
    def unmet(self) -> int:
        """How many parts of the goal do not hold."""
        return int((self.ratios_G > 1).sum())

    @property
    def away(self) -> float:
        """How far the goal is: the sum over its parts, of which none counts more than 5."""
        return float(self.ratios_G.clip(max=5).sum())

    @property
    def key(self) -> tuple[int, int, float]:
        """Best first: every part of the goal that does not hold takes another sentence at least, or so it is hoped."""
        return len(self.instructions) + self.unmet, self.unmet, self.away

    def rollouts(self) -> tuple[Rollout, ...]:
        """What was imagined on the way, B = 1 each."""
        if self.before is None:
            return ()
        return (*self.before.rollouts(), self.batch.select(self.row))


@dataclass
class SearchPlanner:
    """A* search over sentences, with a budget, for the fewest after which the goal is foreseen to hold.

    Whoever searches finds the model's errors, too: a state that only a slip of the model makes a goal. So the shortest
    plans are imagined once more as films, by the model's other predictor, and one is taken that both believe in; if
    there is none, the search goes on for longer ones.

    Raises:
        ValueError: if the budget or the depth is below 1.
    """

    world_model: Foresees
    budget: int = 1000  # sentences that are imagined at most
    depth: int = 4  # sentences of a plan at most
    checked: int = 12  # plans of which films are imagined at most; 0 trusts the search alone
    seed: int = 0  # of the slot sampling
    relations: Sequence[str] = ()  # that may be said; by default all

    def __post_init__(self) -> None:
        for name in ("budget", "depth"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1 sentence, not {getattr(self, name)}")

    def plan(self, rgb: NDArray[np.uint8], goal: AnyGoal, grounder: Grounder) -> Plan:
        """The best sequence; see `Planner.plan`. Its rollouts have two frames each: before a sentence, and after."""
        began = perf_counter()
        parsed, grounding, wanted = look = self.look(rgb, goal, grounder)
        things, sentences = sorted(grounding.things), grounding.instructions(*self.relations)
        if isinstance(goal, Goal):  # its own sentences first: of equally good plans the obvious one
            sentences = tuple(sorted(sentences, key=lambda one: one not in goal.instructions))
        if not sentences:
            raise GroundingError(f"nothing can be said of {', '.join(map(str, things)) or 'an empty scene'}")
        start = _State(parsed, 0)
        found: list[_State] = []  # all that was imagined
        goals: list[_State] = []  # those of one length in which the goal holds
        known_MN2 = places(parsed, grounding, things)
        frontier: list[tuple[tuple[int, int, float], int, _State]] = [((0, 0, 0.0), 0, start)]
        left, best = self.budget, None
        while frontier and left:
            _, _, state = heappop(frontier)
            if goals and state.key[0] > len(goals[0].instructions):  # nothing that is as short is left
                if (best := self._borne_out(goals, look)) is not None:
                    break
                goals = []
            if state.before is not None and state.unmet == 0:
                # One sentence may bring about several parts: a shorter way can come to light late.
                shorter = goals and len(state.instructions) < len(goals[0].instructions)
                goals = [state] if shorter else [*goals, state]
            elif len(state.instructions) < (len(goals[0].instructions) if goals else self.depth):
                said, left = sentences[:left], left - len(sentences[:left])
                ends = self._foresee(state.batch.last.select(state.row), said, grounding)
                places_BN2 = places(ends, grounding, things)
                ratios_BG, zoom_BN = wanted.ratios(places_BN2).numpy(), grounding.view.zoom(places_BN2)
                for row, (one, ratios_G) in enumerate(zip(said, ratios_BG, strict=True)):
                    new = _State(ends, row, (*state.instructions, one), state, ratios_G)
                    apart_MN = (known_MN2 - places_BN2[row]).norm(dim=-1) / zoom_BN[row]
                    known_M = apart_MN.amax(1) < MERGED_PX
                    if known_M.any() and new.unmet:  # of ways to the goal all are kept: some may be slips
                        continue
                    known_MN2 = torch.cat([known_MN2, places_BN2[row : row + 1]])
                    found.append(new)
                    heappush(frontier, (new.key, len(found), new))
        if not found:  # as far as can be foreseen, nothing changes anything
            raise GroundingError("no sentence is imagined to move anything")
        found.sort(key=lambda one: (one.unmet, one.key))
        if not goals:  # the budget may have ended before it was their turn
            waiting = sorted((one for *_, one in frontier if one.unmet == 0), key=lambda one: one.key)
            goals = [one for one in waiting if one.key[0] == waiting[0].key[0]]
        best = best or self._borne_out(goals, look) or (found[0], found[0].rollouts())
        ranked = [best[0], *(one for one in found[:SHOWN] if one is not best[0])]
        ranking = tuple(Candidate(one.instructions, -one.away, one.unmet == 0) for one in ranked)
        return Plan(ranking, best[1], grounding, perf_counter() - began)

    def _borne_out(
        self, goals: Sequence[_State], look: tuple[Rollout, Grounding, Wanted]
    ) -> tuple[_State, tuple[Rollout, ...]] | None:
        """Of goal states of one length the first whose films end in the goal, too, and these; None if there is none."""
        if not goals or not self.checked:
            return (goals[0], goals[0].rollouts()) if goals else None
        goals = sorted(goals, key=lambda one: one.away)[: self.checked]
        parsed, grounding, wanted = look
        films: list[Rollout] = []
        for step in range(len(goals[0].instructions)):
            texts = [one.instructions[step].text for one in goals]
            before = films[-1].last if films else parsed.select([0] * len(goals))
            horizon = frames_ahead(self.world_model)
            films.append(self.world_model.rollout(before, texts, horizon=horizon, seed=self.seed))
        ends_BG = wanted.ratios(places(films[-1], grounding, sorted(grounding.things)))
        for row in torch.nonzero((ends_BG <= 1).all(1)).flatten().tolist():
            return goals[row], tuple(film.select(row) for film in films)
        return None

    def reached(self, rgb: NDArray[np.uint8], goal: AnyGoal, grounder: Grounder) -> bool:
        """Whether everything is seen to be where it shall be."""
        try:
            parsed, grounding, wanted = self.look(rgb, goal, grounder)
        except GroundingError:
            return False
        return bool((wanted.ratios(places(parsed, grounding, sorted(grounding.things))) <= 1).all())

    def look(self, rgb: NDArray[np.uint8], goal: AnyGoal, grounder: Grounder) -> tuple[Rollout, Grounding, Wanted]:
        """What a picture (H, W, 3) shows, and what is wanted of it; a GroundingError where the two do not fit."""
        parsed, grounding = observe(self.world_model, rgb, goal, grounder, self.seed)
        things = sorted(grounding.things)
        if isinstance(goal, PictureGoal):
            shown, its = observe(self.world_model, goal.rgb, goal, grounder, self.seed)
            return parsed, grounding, Wanted.of_picture(shown, its, things)
        return parsed, grounding, Wanted.of_relations(goal, things, grounding.view)

    def _foresee(self, state: Rollout, said: Sequence[Instruction], grounding: Grounding) -> Rollout:
        """Where each of some sentences leads from a state (B = 1)."""
        return self.world_model.outcome(state, [one.text for one in said], seed=self.seed)


@dataclass
class BelievingPlanner(SearchPlanner):
    """The same search, but every sentence is believed to come true as it says. A control row."""

    checked: int = 0

    def _foresee(self, state: Rollout, said: Sequence[Instruction], grounding: Grounding) -> Rollout:
        positions_BK2 = state.positions[:, -1].repeat(len(said), 1, 1)
        for positions_K2, one in zip(positions_BK2, said, strict=True):
            thing, target = (list(grounding.slots_of(its)) for its in one.things)
            place_2, offset_2 = positions_K2[target].mean(0), RELATIONS[one.relation].offset_px
            positions_K2[thing] = place_2 + grounding.view.raised(place_2.new_tensor(offset_2), place_2)
        return state.moved(positions_BK2, [one.text for one in said])


class LiteralPlanner(SearchPlanner):
    """Imagines nothing: says what the goal says, in its order, while it is not seen to be fulfilled. A control row."""

    def plan(self, rgb: NDArray[np.uint8], goal: AnyGoal, grounder: Grounder) -> Plan:
        """See `Planner.plan`; a ValueError for a goal without sentences."""
        if isinstance(goal, PictureGoal):
            raise ValueError("a picture has no sentences of its own that could be carried out")
        began = perf_counter()
        parsed, grounding, wanted = self.look(rgb, goal, grounder)
        ratios_G = wanted.ratios(places(parsed, grounding, sorted(grounding.things)))[0]
        pairs = zip(goal.instructions, ratios_G, strict=True)
        said = tuple(one for one, ratio in pairs if ratio > 1) or goal.instructions
        return Plan((Candidate(said, 0.0, False),), (parsed,) * len(said), grounding, perf_counter() - began)


@dataclass
class AnySentencePlanner(SearchPlanner):
    """Says anything that the scene allows. A control row."""

    rng: np.random.Generator = field(default_factory=np.random.default_rng)

    def plan(self, rgb: NDArray[np.uint8], goal: AnyGoal, grounder: Grounder) -> Plan:
        """See `Planner.plan`."""
        began = perf_counter()
        parsed, grounding, _ = self.look(rgb, goal, grounder)
        sentences = grounding.instructions()
        said = sentences[int(self.rng.integers(len(sentences)))]
        return Plan((Candidate((said,), 0.0, False),), (parsed,), grounding, perf_counter() - began)
