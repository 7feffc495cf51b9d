"""What one open page plays with: a scene in its own simulator, and the model that all pages share."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError

from experiments.play.links import Link, Refused
from experiments.play.plans import plan_data
from experiments.play.tabletop import Tabletop, slot_names
from experiments.play.worlds import Choice
from experiments.study.foresight import foresight
from planning import Goal, PictureGoal, SearchPlanner
from planning.planners import frames_ahead
from textocvp import Rollout, WorldModel
from textocvp.film_page import film_data, picture_url, save_page
from textocvp.pictures import SUFFIXES, read_picture, save_film

MOST_SENTENCES = 12  # side by side
FILMS = 60  # of a plan by a model that foresees no outcome in one step
MOST_PIXELS = 50_000_000  # of a picture, which are unpacked to four bytes each


@dataclass(frozen=True)
class Shown:
    """What was imagined, what its slots are called, and what happened (T, H, W, 3) where it was carried out."""

    rollout: Rollout
    names: Mapping[int, str]
    real: np.ndarray | None = None


_heard = threading.local()


@contextmanager
def heard() -> Iterator[list[str]]:
    """The warnings of this thread, as sentences. `warnings.catch_warnings` would take those of other threads, too."""
    if warnings.showwarning is not _keep:
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = _keep
    _heard.sentences = []
    try:
        yield _heard.sentences
    finally:
        del _heard.sentences


def _keep(message: Warning | str, *_: Any, **__: Any) -> None:
    if hasattr(_heard, "sentences"):
        _heard.sentences.append(str(message))


class Session:
    """One page's scene. Its methods are called by one thread at a time; `lock` sees to that.

    Raises:
        Refused, ValueError, GroundingError: from every method that takes wishes, with a sentence for the page.
    """

    def __init__(self, world_model: WorldModel, choice: Choice, link: Link, horizon: int | None = None) -> None:
        self.world_model, self.choice = world_model, choice
        self.lock = threading.Lock()
        self.world = choice.make(world_model.image_size[0])
        horizon = horizon or self.world.horizon or frames_ahead(world_model)
        self.horizon = min(horizon, world_model.longest_horizon or horizon)
        self.picture: np.ndarray | None = None  # a person's own, instead of the scene
        self.goal: Goal | PictureGoal | None = None
        self.before_goal: Link | None = None  # the scene, while the goal is arranged
        self.goal_supports: Mapping[str, str] = {}  # of a goal that was arranged
        self.shown: list[Shown] = []  # what may be downloaded, in the order of the page
        self.acts: list[Shown] = []  # that the page shows beside each other; plans are made between them
        try:
            self.world.show(link)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Give the simulator back."""
        self.world.close()

    # -- the scene ---------------------------------------------------------------------------------------------

    def new_scene(self, link: Link) -> None:
        """Another scene, with no goal yet."""
        self.world.show(link)
        self.picture = self.goal = self.before_goal = None

    @property
    def seen(self) -> np.ndarray:
        """The picture (H, W, 3) that films begin with."""
        return self.world.rgb if self.picture is None else self.picture

    def about(self) -> dict[str, Any]:
        """What the page must know of the world: what can be done there."""
        return {"edits": isinstance(self.world, Tabletop), "families": list(self.world.families)}

    def view(self) -> dict[str, Any]:
        """The scene as the page shows it."""
        own, link = self.picture is not None, self.world.link
        parsed = self.world_model.parse(self.seen[None]) if own else None
        return {
            "picture": picture_url(self.seen),
            "size": [self.seen.shape[1], self.seen.shape[0]],
            "own_picture": own,
            "link": f"world={self.choice.name}&{link.query()}",
            "seed": str(link.seed),
            "family": link.family,
            "task": self.world.task,
            "sentences": self.world.sentences(parsed),
            "things": [] if own else [{"id": n, **one} for n, one in enumerate(self.world.things())],
            "arranging": self.before_goal is not None,
        }

    @property
    def table(self) -> Tabletop:
        """The world, where things can be arranged in it and the scene is what is seen."""
        if not isinstance(self.world, Tabletop):
            raise Refused("in this world things stay as they are drawn, and no plans are made; take another scene")
        if self.picture is not None:
            raise Refused("this is your own picture, in which nothing can be moved; go back to the scene")
        return self.world

    def upload(self, data: bytes) -> list[str]:
        """Take a picture file instead of the scene; what was done to it."""
        if self.before_goal is not None:
            self._check_scene()
        try:
            with Image.open(BytesIO(data)) as opened:
                large = opened.width * opened.height > MOST_PIXELS
            if not large:
                picture, done = read_picture(BytesIO(data), self.world_model.image_size, resize=True)
        except Image.DecompressionBombError:
            large = True
        except Exception as error:  # pictures are damaged in many ways
            what = "it is of no known kind" if isinstance(error, UnidentifiedImageError) else str(error)
            raise Refused(f"this is no picture that can be read: {what}") from None
        if large:
            raise Refused(f"the picture has too many pixels: more than {MOST_PIXELS // 10**6} million")
        self.picture = picture
        return done

    # -- imagining and doing -----------------------------------------------------------------------------------

    def imagine(self, texts: Sequence[str]) -> list[dict[str, Any]]:
        """One film a sentence."""
        if not 1 <= len(texts) <= MOST_SENTENCES:
            raise Refused(f"give 1 to {MOST_SENTENCES} sentences, not {len(texts)}")
        self.shown = [self._imagined(texts)]
        return self.films(self.shown[0])

    def _imagined(self, texts: Sequence[str]) -> Shown:
        rollout = self.world_model.rollout(self.seen, list(texts), horizon=self.horizon, attention=True)
        return Shown(rollout, self.world.names(rollout.select(0), self.picture is not None))

    def films(self, shown: Shown) -> list[dict[str, Any]]:
        """Films with the names of their things."""
        rollout, rows = shown.rollout, enumerate(map(self.world_model.words, shown.rollout.texts))
        return [film_data(rollout, words, shown.names, row=row, real=shown.real) for row, words in rows]

    def do(self, text: str, more: bool = False) -> dict[str, Any]:
        """Carry a sentence out: the imagined film beside what happened, and whether the goal is reached.

        Args:
            more: whether the page shows it beside what was done before.
        """
        self._check_scene()
        wish = self._read(text)
        imagined = self._imagined([text])
        done = replace(imagined, real=self.world.act(wish, imagined.rollout))
        self.acts = self.shown = [*(self.acts if more else ()), done]
        return {"film": self.films(done)[0], **self.goal_state()}

    def _read(self, text: str) -> Any:
        """A sentence of any wording that the model understands."""
        try:
            return self.world.read(text)
        except ValueError:
            with suppress(ValueError):
                return self.world.read(self.world_model.reads(text))
            raise

    def save(self, path: Path) -> None:
        """What the page shows as a GIF, MP4 or PNG, or as a page of its own; acts and plans one after another."""
        if not self.shown:
            raise Refused("nothing has been imagined yet")
        if path.suffix == ".html":
            films = [film for one in self.shown for film in self.films(one)]
            save_page(path, "; ".join(film["text"] for film in films), films)
        elif path.suffix in SUFFIXES:
            rollouts = [one.rollout for one in self.shown]
            frames, masks = (
                torch.cat([getattr(rollout, name) for rollout in rollouts], dim=1).cpu().numpy()
                for name in ("frames", "masks")
            )
            texts = [", then ".join(parts) for parts in zip(*(one.texts for one in rollouts), strict=True)]
            # A real film is as long as the imagined one, so that both stay in step.
            reals = [one.real[: one.rollout.slots.shape[1]] for one in self.shown if one.real is not None]
            save_film(path, frames, masks, texts, beside=np.concatenate(reals) if reals else None)
        else:
            raise Refused(f"films are {', '.join(SUFFIXES)} and .html, not {path.suffix!r}")

    # -- goals and plans ---------------------------------------------------------------------------------------

    def arrange_goal(self, what: str) -> None:
        """Begin to arrange the scene as it shall be; `use` that as the goal, or `cancel`: both bring the scene back."""
        table = self.table
        if what == "begin":
            self._check_scene()
            before = table.link
            table.arrange(table.layout())  # which stands still as it is after acts
            self.before_goal = before
            return
        if self.before_goal is None:
            raise Refused("no goal is being arranged")
        if what == "use":
            self.goal, self.goal_supports = PictureGoal(table.rgb), table.supports
        before, self.before_goal = self.before_goal, None
        table.show(before)

    def goal_state(self) -> dict[str, Any]:
        """Whether the goal is seen to be reached, and whether the simulator says so; nothing without a goal."""
        if self.goal is None:
            return {}
        true = False
        with suppress(ValueError):  # what the goal names may have been taken away
            true = self._is_reached(self.goal)
        seen = self._planner(self.goal).reached(self.table.rgb, self.goal, self.table.grounder)
        return {"reached": {"seen": seen, "true": true}}

    def _is_reached(self, goal: Goal | PictureGoal) -> bool:
        if isinstance(goal, PictureGoal):
            return self.table.supports == self.goal_supports
        return self.table.is_reached(goal)

    def _planner(self, goal: Goal | PictureGoal) -> SearchPlanner:
        model = foresight(self.world_model)
        relations = self.table.relations
        if self.world_model.foresees:
            return SearchPlanner(model, relations=relations)
        # Whole films take long, so only plans as short as the goal allows.
        return SearchPlanner(model, budget=FILMS, depth=goal.steps, relations=relations)

    def plan(self, text: str) -> dict[str, Any]:
        """Search for the goal of a sentence, or for the one that was arranged where there is no sentence."""
        table = self.table
        self._check_scene()
        goal = Goal.parse(text) if text.strip() else self.goal
        if goal is None:
            raise Refused("say what the goal is, or arrange it")
        self._is_reached(goal)
        self.goal = goal
        state = self.goal_state()
        if state["reached"]["seen"]:
            return {"done": True, **state}
        plan = self._planner(goal).plan(table.rgb, goal, table.grounder)
        if mistaken := set(map(str, plan.grounding.things)) - {one["name"] for one in table.things()}:
            said = " and ".join(f"a {name}" for name in sorted(mistaken))
            warnings.warn(f"the planner sees {said}, which is not there", UserWarning, stacklevel=1)
        names = slot_names(plan.grounding)
        self.shown = [Shown(one, names) for one in plan.rollouts]
        films = [film_data(one, (), names) for one in plan.rollouts]
        return {"done": False, "films": films, **plan_data(foresight(self.world_model), table.rgb, goal, plan)}

    def _check_scene(self) -> None:
        if self.picture is not None:
            raise Refused("this is your own picture, with no simulator behind it; go back to the scene for that")
        if self.before_goal is not None:
            raise Refused("a goal is being arranged: say that this is the goal, or cancel")
