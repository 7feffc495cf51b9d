"""What a task is: the sentences that may be said, the scenes, what the expert does, and when it is done."""

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import permutations
from math import dist
from typing import ClassVar, NamedTuple

import numpy as np

from ..checks import check_choice
from ..colors import CAPTION_COLORS, COLORS, ColorSplit
from ..geometry import Sizes
from ..physics.robot import Robot
from ..physics.simulation import Tabletop
from ..sampling import SceneRequest, sample_objects
from ..scene import GoalPair, Instruction, ObjectSpec, Scene, Thing

CLIPORT_RADIUS = 0.05  # metres in the plane from its place within which CLIPort calls it success


class Question(NamedTuple):
    """A sentence of one step that a scene allows."""

    text: str
    moves: int  # id of the object that should move
    ends_at: int  # id of the object at which it should end


class Relation(ABC):
    """What one instruction asks: ``the <color> <thing> <name> the <color> <target>`` shall be true.

    The expert picks at the thing and lets go at `place`.
    """

    name: ClassVar[str]  # the words between thing and target, such as "in"
    kinds: ClassVar[tuple[str, str]]  # kinds of the thing, which moves, and of the target, at which it ends
    exclusive: ClassVar[bool] = False  # whether a target has room for one thing only

    def between(self, thing_color: str, target_color: str) -> Instruction:
        """The instruction that asks for it."""
        thing, target = self.kinds
        return Instruction(self.name, Thing(thing_color, thing), Thing(target_color, target))

    @abstractmethod
    def fulfilled(self, world: Tabletop, robot: Robot, pair: GoalPair) -> bool:
        """Whether it is true now. The simulator alone judges."""

    @abstractmethod
    def fulfilled_at_start(self, objects: Sequence[ObjectSpec], thing: int, target: int) -> bool:
        """Whether it is true of two objects (ids) of a layout."""

    def place(self, world: Tabletop, pair: GoalPair) -> tuple[float, float]:
        """Where to let go of the thing, (x, y) in metres: over the target's centre."""
        x, y, _ = world.pose(pair.target)[0]
        return x, y

    def is_near(self, world: Tabletop, pair: GoalPair) -> bool:
        """CLIPort's criterion: the thing is within 5 cm of its place in the plane, in hand or not."""
        return dist(world.pose(pair.thing)[0][:2], self.place(world, pair)) < CLIPORT_RADIUS


@dataclass(frozen=True)
class Task:
    """What an environment may ask for: ``put the red block in the blue bowl [and the ...]``.

    Random scenes name things for the first relation; a task that wants others overrides `sample`.
    """

    relations: tuple[Relation, ...]
    pairs: tuple[int, int] = (1, 1)  # fewest and most of a random goal; a given instruction has 1 to the most
    attempts: int = 3  # pick-and-places until an episode is truncated, for each pair of a random goal
    stacks: bool = False  # whether blocks may start on each other, and pictures may be goals
    scene_options: tuple[str, ...] = ("n_objects", "n_bowls", "color_split", "blocks_in_bowls", "target_in_bowl")
    """Reset options that describe a random scene, or its goal."""

    @property
    def vocabulary(self) -> tuple[str, ...]:
        """Every word that the sentences can contain, in a fixed order: the grammar's, then the colours."""
        words = " ".join(["put", *(str(relation.between("", "")) for relation in self.relations)]).split()
        words += ["and"] * (self.pairs[1] > 1)
        return tuple(dict.fromkeys([*words, *COLORS]))

    @property
    def longest_sentence(self) -> int:
        """Characters of the longest sentence."""
        color = max(COLORS, key=len)
        return max(len(self.format([r.between(color, color)] * self.pairs[1])) for r in self.relations)

    def format(self, instructions: Iterable[Instruction]) -> str:
        """The sentence that asks for ``instructions``; ValueError for none or for an unknown colour."""
        steps = list(instructions)
        if not steps:
            raise ValueError("a sentence needs at least one instruction")
        for step in steps:
            _check_colors(step)
        return "put " + " and ".join(map(str, steps))

    def parse(self, text: str) -> tuple[Instruction, ...]:
        """The instructions of a sentence; the inverse of `format`.

        Letter case, repeated spaces and a final full stop do not matter.

        Raises:
            ValueError: when the text is not of the grammar, names an unknown colour, or moves a thing twice.
        """
        known = " | ".join(str(relation.between("<color>", "<color>")) for relation in self.relations)
        form = f"the form is: put {known} [and {known} ...]"
        if not isinstance(text, str):
            raise ValueError(f"an instruction is a string, not {type(text).__name__}; {form}")
        plain = " ".join(text.lower().rstrip(". ").split())
        if not plain.startswith("put "):
            raise ValueError(f"cannot read the instruction {text!r}; {form}")
        steps: list[Instruction] = []
        for part in plain.removeprefix("put ").split(" and "):
            step = self._parse_step(part)
            if step is None:
                raise ValueError(f"cannot read {part!r} in the instruction {text!r}; {form}")
            _check_colors(step)
            if step.thing == step.target:
                raise ValueError(f"the instruction {text!r} asks for the {step.thing} {step.relation} itself")
            if step.thing in [before.thing for before in steps]:
                raise ValueError(f"the instruction {text!r} names one {step.thing.kind} twice")
            steps.append(step)
        return tuple(steps)

    def check_instructions(self, instructions: Sequence[Instruction]) -> None:
        """Raise ValueError for too many instructions, or a target named twice that has room for one thing."""
        count, most = len(instructions), self.pairs[1]
        if count > most:
            raise ValueError(
                f"this environment takes instructions of at most {most} (thing, target) pairs, not {count}"
            )
        for relation in self.relations:
            targets = [step.target for step in instructions if step.relation == relation.name]
            if relation.exclusive and len(set(targets)) < len(targets):
                thing, target = relation.kinds
                raise ValueError(f"an instruction must not name a {target} twice: a {target} has room for one {thing}")

    def relation(self, step: GoalPair | Instruction) -> Relation:
        """The relation that a goal pair or an instruction names."""
        return next(relation for relation in self.relations if relation.name == step.relation)

    def find_goal(self, objects: Sequence[ObjectSpec], steps: Sequence[Instruction]) -> tuple[GoalPair, ...]:
        """The ids of what is named; ValueError when the scene does not have exactly one thing called so."""
        things = [item.thing for item in objects]
        ids = {thing: index for index, thing in enumerate(things)}
        for thing in (thing for step in steps for thing in step.things):
            if thing not in ids:
                raise ValueError(f"the scene has no {thing}; it has: {', '.join(map(str, things))}")
            if things.count(thing) > 1:
                raise ValueError(f"the scene has {things.count(thing)} objects that are a {thing}")
        return tuple(GoalPair(step.relation, ids[step.thing], ids[step.target]) for step in steps)

    def request(self, n_pairs: int = 1) -> SceneRequest:
        """What random scenes are like by default, with ``n_pairs`` (thing, target) pairs to name."""
        return SceneRequest(named=self.relations[0].kinds * n_pairs)

    def sample(self, rng: np.random.Generator, request: SceneRequest, sizes: Sizes) -> Scene:
        """Draw a scene: kinds, colours, a goal that is not reached yet, and places."""
        low, high = request.bowl_range
        n_bowls = int(rng.integers(low, high + 1)) if request.n_bowls is None else request.n_bowls
        steps = request.instructions
        if not steps:
            colors = rng.permutation(CAPTION_COLORS[request.color_split])[: len(request.named)].tolist()
            steps = tuple(map(self.relations[0].between, colors[::2], colors[1::2]))
        objects = sample_objects(rng, request, n_bowls, [t for step in steps for t in step.things], sizes)
        return self.scene(objects, self.find_goal(objects, steps))

    def scene(self, objects: tuple[ObjectSpec, ...], goal: tuple[GoalPair, ...]) -> Scene:
        """A given layout with a goal."""
        steps = [Instruction(p.relation, objects[p.thing].thing, objects[p.target].thing) for p in goal]
        return Scene(objects, goal, self.format(steps))

    def fulfilled(self, world: Tabletop, robot: Robot, scene: Scene) -> list[bool]:
        """Whether each part of the scene's goal is true now. The reward is the change in their share."""
        return [self.relation(pair).fulfilled(world, robot, pair) for pair in scene.goal]

    def asked(self, scene: Scene) -> tuple[GoalPair, ...]:
        """What `fulfilled` judges, in its order; a target of `TABLE` is the table."""
        return scene.goal

    def true_of(self, world: Tabletop, robot: Robot, scene: Scene, things: set[int]) -> list[GoalPair]:
        """All that is true now of the things with these ids, asked for or not."""
        kinds = [item.kind for item in scene.objects]
        return [
            pair
            for relation in self.relations
            for thing, target in permutations(range(len(kinds)), 2)
            if thing in things and (kinds[thing], kinds[target]) == relation.kinds
            if relation.fulfilled(world, robot, pair := GoalPair(relation.name, thing, target))
        ]

    def destination(self, world: Tabletop, scene: Scene, pair: GoalPair) -> tuple[float, float, float]:
        """Where a pair that is `asked` wants its thing: (x, y) over the target, and the target's height; metres."""
        return *self.relation(pair).place(world, pair), world.pose(pair.target)[0][2]

    def succeeded(self, world: Tabletop, robot: Robot, scene: Scene) -> bool:
        """Whether the whole goal is true now."""
        return all(self.fulfilled(world, robot, scene))

    def fulfilled_at_start(self, scene: Scene) -> bool:
        """Whether a layout is already as its goal says."""
        layout = scene.objects
        return all(self.relation(pair).fulfilled_at_start(layout, pair.thing, pair.target) for pair in scene.goal)

    def check_scene(self, scene: Scene) -> None:
        """Raise ValueError for a layout with a goal that it already fulfils, or that it cannot reach."""
        if self.fulfilled_at_start(scene):
            raise ValueError("the layout already fulfils the instruction; ask for something else")

    def with_family(self, request: SceneRequest, family: str) -> SceneRequest:
        """The request for a scene of one of the task's families; ValueError where it has none."""
        raise ValueError(f"this task has no families of scenes, such as {family!r}")

    def picture_scene(self, objects: tuple[ObjectSpec, ...], picture: Sequence[ObjectSpec]) -> Scene:
        """A layout with the picture of another as its goal; ValueError where the task has none."""
        raise ValueError("this task has no pictures as goals")

    def open_pairs(self, objects: Sequence[ObjectSpec], color_split: ColorSplit) -> list[GoalPair]:
        """What may be asked for in a layout: its colours may be named, it is not so yet, there is room."""
        colors = CAPTION_COLORS[color_split]
        found = []
        for pair in self._pairs(objects):
            relation = self.relation(pair)
            rivals = range(len(objects)) if relation.exclusive else [pair.thing]
            taken = any(relation.fulfilled_at_start(objects, rival, pair.target) for rival in rivals)
            if not taken and all(objects[index].color in colors for index in (pair.thing, pair.target)):
                found.append(pair)
        return found

    def draw_goal(
        self, rng: np.random.Generator, objects: Sequence[ObjectSpec], color_split: ColorSplit, n_pairs: int
    ) -> tuple[GoalPair, ...]:
        """Up to ``n_pairs`` open pairs of a layout; none shares a thing or a target with another."""
        goal: list[GoalPair] = []
        pairs = self.open_pairs(objects, color_split)
        while pairs and len(goal) < n_pairs:
            goal.append(pairs[int(rng.integers(len(pairs)))])
            _, thing, target = goal[-1]
            pairs = [pair for pair in pairs if pair.thing != thing and pair.target != target]
        return tuple(goal)

    def questions(self, objects: Sequence[ObjectSpec]) -> tuple[Question, ...]:
        """Every sentence of one step about the objects, also those that are true already."""
        return tuple(
            Question(self.scene(tuple(objects), (pair,)).instruction, pair.thing, pair.target)
            for pair in self._pairs(objects)
        )

    def _pairs(self, objects: Sequence[ObjectSpec]) -> list[GoalPair]:
        """All pairs of objects of the right kinds that have a name of their own and nothing on top."""
        things, covered = [item.thing for item in objects], {item.on for item in objects}
        ids = [i for i, thing in enumerate(things) if things.count(thing) == 1 and i not in covered]
        return [
            GoalPair(relation.name, thing, target)
            for relation in self.relations
            for thing, target in permutations(ids, 2)
            if (objects[thing].kind, objects[target].kind) == relation.kinds
        ]

    def _parse_step(self, part: str) -> Instruction | None:
        for relation in self.relations:
            if match := re.fullmatch(str(relation.between("([a-z]+)", "([a-z]+)")), part):
                return relation.between(*match.groups())
        return None


def _check_colors(step: Instruction) -> None:
    for thing in step.things:
        check_choice("colour", thing.color, COLORS, form=str)
