"""Blocks in bowls and on blocks, where a sentence does not always lead to what it says."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from itertools import count
from math import hypot
from typing import NamedTuple

import numpy as np

from ..checks import check_choice
from ..colors import CAPTION_COLORS, COLORS, ColorSplit
from ..geometry import Sizes
from ..physics.robot import Robot
from ..physics.simulation import Tabletop
from ..physics.supports import SETTLED_SPEED, supports
from ..sampling import SceneRequest, place_objects
from ..scene import NOWHERE, TABLE, GoalPair, ObjectSpec, Scene, Thing
from .base import Question, Relation, Task
from .put_in_bowl import In

Supports = tuple[int, ...]  # of each object by id: what carries it, see `envs.physics.supports`
Surprises = Mapping[tuple[Supports, GoalPair], Supports]  # sentences that led elsewhere than they should

PICTURE_SENTENCE = "rearrange the blocks as in the picture"
HIGHEST = 2  # objects under a block, in goals and on the way to them: towers of three, two blocks in a bowl
MOST_SENTENCES = 4  # between a random arrangement and the picture of another
MAX_DRAWS = 200  # of a goal from one arrangement
MAX_STATES = 20_000  # arrangements that a search looks at
SAME_PLACE = 0.02  # metres between two pictures of a thing that stands still


class On(Relation):
    """A block stands on another, which has room for one."""

    name = "on"
    kinds = ("block", "block")
    exclusive = True

    def fulfilled(self, world: Tabletop, robot: Robot, pair: GoalPair) -> bool:
        """Whether the other block carries it, and nothing moves any more."""
        return supports(world, robot)[pair.thing] == pair.target and world.speed(pair.thing) < SETTLED_SPEED

    def fulfilled_at_start(self, objects: Sequence[ObjectSpec], thing: int, target: int) -> bool:
        return objects[thing].on == target


class Family(NamedTuple):
    """A kind of random scene. Numbers are places in `kinds`."""

    kinds: tuple[str, ...]  # of the things that the goal or the way to it names
    carriers: dict[int, int]  # which of them starts in or on which
    goal: tuple[GoalPair, ...]  # empty where the goal is a picture


FAMILIES: dict[str, Family] = {
    "plain": Family(("block", "bowl"), {}, (GoalPair("in", 0, 1),)),
    "occupied": Family(("block", "bowl", "block", "bowl"), {2: 1}, (GoalPair("in", 0, 1),)),
    "covered": Family(("block", "bowl", "block", "bowl"), {2: 0}, (GoalPair("in", 0, 1),)),
    "swap": Family(
        ("block", "bowl", "block", "bowl", "bowl"), {0: 1, 2: 3}, (GoalPair("in", 0, 3), GoalPair("in", 2, 1))
    ),
    "tower": Family(("block", "block", "block", "bowl"), {}, (GoalPair("on", 1, 0), GoalPair("on", 2, 1))),
    "picture": Family(("block", "bowl", "block", "bowl", "block"), {}, ()),
}
"""Name -> what it is: another block fills the named bowl, or stands on the named block; two blocks are to change bowls;
three are to be a tower; a picture shows the goal."""


@dataclass(frozen=True)
class Rearrange(Task):
    """Bring about relations, or the arrangement of a picture. What stands on what decides, see `holds`."""

    relations: tuple[Relation, ...] = (In(), On())
    pairs: tuple[int, int] = (1, 5)
    attempts: int = 8
    scene_options: tuple[str, ...] = ("family", "n_objects", "n_bowls", "color_split", "goal_layout")
    stacks: bool = True

    # -- What holds ----------------------------------------------------------------------------------------

    def holds(self, carried_by: Supports, scene: Scene) -> list[bool]:
        """For each pair of the goal, whether the supports are as it says; for a picture, for each block.

        A thing that a pair names must carry nothing but what another pair puts there.
        """
        if scene.picture is not None:
            blocks = [index for index, item in enumerate(scene.picture) if item.kind == "block"]
            return [carried_by[index] == scene.picture[index].support for index in blocks]
        asked = {pair.thing: pair.target for pair in scene.goal}
        loads = [(index, support) for index, support in enumerate(carried_by) if support in asked]
        unasked = {support for index, support in loads if asked.get(index) != support}
        return [carried_by[thing] == target and thing not in unasked for thing, target in asked.items()]

    def fulfilled(self, world: Tabletop, robot: Robot, scene: Scene) -> list[bool]:
        return self.holds(supports(world, robot), scene)

    def asked(self, scene: Scene) -> tuple[GoalPair, ...]:
        if scene.picture is None:
            return scene.goal
        blocks = [index for index, item in enumerate(scene.picture) if item.kind == "block"]
        return _as_pairs(scene, [scene.picture[index].support for index in blocks], blocks)

    def true_of(self, world: Tabletop, robot: Robot, scene: Scene, things: set[int]) -> list[GoalPair]:
        carried_by = supports(world, robot)
        found = [index for index in sorted(things) if carried_by[index] != NOWHERE]
        return [*_as_pairs(scene, [carried_by[index] for index in found], found)]

    def destination(self, world: Tabletop, scene: Scene, pair: GoalPair) -> tuple[float, float, float]:
        if pair.target != TABLE:
            return super().destination(world, scene, pair)
        assert scene.picture is not None  # only pictures ask for the table
        return scene.picture[pair.thing].x, scene.picture[pair.thing].y, 0.0

    def succeeded(self, world: Tabletop, robot: Robot, scene: Scene) -> bool:
        """Whether all holds, every object rests, and the gripper is empty and back home."""
        still = all(world.speed(index) < SETTLED_SPEED for index in range(len(world.objects)))
        return still and robot.holding < 0 and robot.is_home and super().succeeded(world, robot, scene)

    # -- What sentences lead to ----------------------------------------------------------------------------

    def solve(self, scene: Scene, start: Supports, surprises: Surprises | None = None) -> tuple[GoalPair, ...] | None:
        """The fewest sentences that should lead from ``start`` to the scene's goal, by the rule of `outcome`.

        ``surprises`` overrule it. None when `MAX_STATES` arrangements show no way.
        """
        known = {} if surprises is None else surprises
        wanted = dict(enumerate(item.support for item in scene.picture or ()))
        wanted |= {pair.thing: pair.target for pair in scene.goal}
        sentences = self._pairs(scene.objects)
        # A* search: a sentence moves one block, so as many are needed as blocks are elsewhere.
        lengths, order, highest = {start: 0}, count(), max(HIGHEST, _highest(start))
        frontier: list[tuple[int, int, Supports, tuple[GoalPair, ...]]] = [(0, next(order), start, ())]
        while frontier and len(lengths) < MAX_STATES:
            _, _, state, plan = heappop(frontier)
            if all(self.holds(state, scene)):
                return plan
            for sentence in sentences:
                after = known.get((state, sentence)) or arrangement_after(state, sentence)
                length = len(plan) + 1
                if length < lengths.get(after, length + 1) and _highest(after) <= highest:
                    lengths[after] = length
                    rest = sum(after[index] != support for index, support in wanted.items())
                    heappush(frontier, (length + rest, next(order), after, (*plan, sentence)))
        return None

    def questions(self, objects: Sequence[ObjectSpec]) -> tuple[Question, ...]:
        """Every sentence that should move something, with what it should really move, and to where."""
        start = tuple(item.support for item in objects)
        asked = []
        for pair in self._pairs(objects):
            moved, support = outcome(start, pair)
            if support != start[moved]:
                asked.append(Question(self.scene(tuple(objects), (pair,)).instruction, moved, support))
        return tuple(asked)

    def sentences(self, objects: Sequence[ObjectSpec], color_split: ColorSplit) -> list[GoalPair]:
        """Everything that may be said in one sentence, sensible or not, with the colours of a split."""
        colors = CAPTION_COLORS[color_split]
        return [
            pair
            for pair in self._pairs(objects)
            if {objects[pair.thing].color, objects[pair.target].color}.issubset(colors)
        ]

    def open_pairs(self, objects: Sequence[ObjectSpec], color_split: ColorSplit) -> list[GoalPair]:
        """The goals of one pair that a layout does not fulfil and can reach."""
        start = tuple(item.support for item in objects)
        pairs = self.sentences(objects, color_split)
        return [pair for pair in pairs if self.solve(self.scene(tuple(objects), (pair,)), start)]

    def draw_goal(
        self, rng: np.random.Generator, objects: Sequence[ObjectSpec], color_split: ColorSplit, n_pairs: int
    ) -> tuple[GoalPair, ...]:
        """One open pair: two may exclude each other."""
        return super().draw_goal(rng, objects, color_split, 1)

    # -- Scenes --------------------------------------------------------------------------------------------

    def request(self, n_pairs: int = 1) -> SceneRequest:
        return SceneRequest(named=max((family.kinds for family in FAMILIES.values()), key=_demand))

    def with_family(self, request: SceneRequest, family: str) -> SceneRequest:
        """The request for a scene of this family; ValueError for an unknown one, or one that needs more objects."""
        check_choice("family", family, FAMILIES)
        return replace(request, family=family, named=FAMILIES[family].kinds)

    def sample(self, rng: np.random.Generator, request: SceneRequest, sizes: Sizes) -> Scene:
        """Draw a scene of the family. Captions may name all that matters, and in `picture` as much as they can."""
        name = request.family or str(rng.choice(list(FAMILIES)))
        request, family = self.with_family(request, name), FAMILIES[name]
        low, high = request.bowl_range
        n_bowls = int(rng.integers(low, high + 1)) if request.n_bowls is None else request.n_bowls
        kinds = list(family.kinds)
        kinds += ["bowl"] * (n_bowls - kinds.count("bowl"))
        kinds += ["block"] * (request.n_objects - len(kinds))
        colors = rng.permutation(CAPTION_COLORS[request.color_split]).tolist()
        colors = colors[: len(family.kinds) if family.goal else len(kinds)]
        n_named = len(colors)
        colors += rng.permutation([color for color in COLORS if color not in colors]).tolist()
        ids = rng.permutation(len(kinds)).tolist()  # an id carries no meaning
        things = [Thing(color, kind) for _, color, kind in sorted(zip(ids, colors, kinds, strict=False))]
        distance = 0 if family.goal else int(rng.integers(1, MOST_SENTENCES + 1))
        scene = None
        while scene is None:
            carriers = family.carriers if family.goal else _arrange(rng, kinds[:n_named])
            placed = {ids[block]: ids[lower] for block, lower in carriers.items()}
            objects = place_objects(rng, request, things, placed, sizes)
            if family.goal:
                goal = [GoalPair(pair.relation, ids[pair.thing], ids[pair.target]) for pair in family.goal]
                scene = self.scene(objects, tuple(goal[k] for k in rng.permutation(len(goal))))
            else:
                scene = self._draw_picture(rng, objects, set(ids[:n_named]), distance)
        return replace(scene, family=name)

    def picture_scene(self, objects: tuple[ObjectSpec, ...], picture: Sequence[ObjectSpec]) -> Scene:
        """A layout with the picture of another arrangement of the same things, in any order, as its goal.

        Raises:
            ValueError: when it shows other things, or what stands on the table in both stands elsewhere.
        """
        ids = {item.thing: index for index, item in enumerate(objects)}
        if {item.thing for item in picture} != set(ids) or len(picture) != len(objects):
            names = ", ".join(sorted(str(item.thing) for item in objects))
            raise ValueError(f"the goal_layout is a picture of another scene; it must show: {names}")
        goal = list(objects)
        for item in picture:
            index = ids[item.thing]
            carrier = ids[picture[item.support].thing] if item.support >= 0 else TABLE
            goal[index] = item.carried_by(carrier, objects)
            apart = hypot(item.x - objects[index].x, item.y - objects[index].y)
            if item.stands and objects[index].stands and apart > SAME_PLACE:
                raise ValueError(
                    f"the goal_layout is a picture of another scene: in it the {item.thing} stands {apart:.2f} m away"
                )
        return Scene(objects, (), PICTURE_SENTENCE, tuple(goal))

    def check_scene(self, scene: Scene) -> None:
        super().check_scene(scene)
        if self.solve(scene, tuple(item.support for item in scene.objects)) is None:
            raise ValueError(f"no sentences lead from the layout to the goal {scene.instruction!r}")

    def fulfilled_at_start(self, scene: Scene) -> bool:
        return all(self.holds(tuple(item.support for item in scene.objects), scene))

    def _draw_picture(
        self, rng: np.random.Generator, objects: tuple[ObjectSpec, ...], named: set[int], distance: int
    ) -> Scene | None:
        """A goal that is so many sentences away; None when random sentences come upon none."""
        start = tuple(item.support for item in objects)
        sentences = [pair for pair in self._pairs(objects) if {pair.thing, pair.target} <= named]
        for _ in range(MAX_DRAWS):
            state = start
            for _ in range(distance):
                after = arrangement_after(state, sentences[int(rng.integers(len(sentences)))])
                state = after if _highest(after) <= HIGHEST else state
            if state != start:
                found = Scene(objects, (), PICTURE_SENTENCE, _moved(objects, state))
                if len(self.solve(found, start) or ()) == distance:
                    return found
        return None

    def _pairs(self, objects: Sequence[ObjectSpec]) -> list[GoalPair]:
        """All pairs, sensible or not."""
        return super()._pairs([replace(item, on=None) for item in objects])


def outcome(carried_by: Supports, sentence: GoalPair) -> tuple[int, int]:
    """What a sentence should lead to: the id of the block that moves, and of what carries it then.

    The gripper takes the highest block over the named one, and the block comes to rest on the highest one over the
    named place. Only physics knows what really happens: blocks land askew and fall.
    """
    moved = _top(carried_by, sentence.thing)
    if sentence.target == moved:
        return moved, carried_by[moved]
    lifted = (*carried_by[:moved], TABLE, *carried_by[moved + 1 :])
    return moved, _top(lifted, sentence.target)


def arrangement_after(carried_by: Supports, sentence: GoalPair) -> Supports:
    """The supports that `outcome` leads to."""
    moved, support = outcome(carried_by, sentence)
    return (*carried_by[:moved], support, *carried_by[moved + 1 :])


def with_supports(objects: Sequence[ObjectSpec], carried_by: Supports) -> tuple[ObjectSpec, ...]:
    """The objects, carried as the supports say; their places stay."""
    return tuple(item.carried_by(carried_by[index], objects) for index, item in enumerate(objects))


def _as_pairs(scene: Scene, carriers: Sequence[int], things: Sequence[int]) -> tuple[GoalPair, ...]:
    """That each thing is in or on what carries it."""
    kinds = [scene.objects[carrier].kind if carrier != TABLE else "table" for carrier in carriers]
    names = ["in" if kind == "bowl" else "on" for kind in kinds]
    return tuple(map(GoalPair, names, things, carriers))


def _top(carried_by: Supports, index: int) -> int:
    """The highest object of the stack over one."""
    while index in carried_by:
        index = carried_by.index(index)
    return index


def _highest(carried_by: Supports) -> int:
    """Most objects that are under one."""

    def under(index: int) -> int:
        return 0 if carried_by[index] < 0 else 1 + under(carried_by[index])

    return max(map(under, range(len(carried_by))))


def _arrange(rng: np.random.Generator, kinds: Sequence[str]) -> dict[int, int]:
    """A random arrangement: each block in turn comes to the table, into an empty bowl or on a block."""
    under = {index: 0 for index, kind in enumerate(kinds) if kind == "bowl"}  # how many objects
    carriers: dict[int, int] = {}
    for block in rng.permutation([index for index, kind in enumerate(kinds) if kind == "block"]).tolist():
        taken = set(carriers.values())
        free = [TABLE, *(index for index in under if index not in taken and under[index] < HIGHEST)]
        lower = free[int(rng.integers(len(free)))]
        under[block] = under.get(lower, -1) + 1
        if lower != TABLE:
            carriers[block] = lower
    return carriers


def _moved(objects: tuple[ObjectSpec, ...], carried_by: Supports) -> tuple[ObjectSpec, ...]:
    """The objects, carried as the supports say; what was moved, or is on that, is right over what carries it."""

    def base(index: int) -> ObjectSpec:
        item, support = objects[index], carried_by[index]
        still = support == item.support and (support < 0 or base(support) is objects[support])
        return item if still else base(support)

    bases = [base(index) for index in range(len(objects))]
    placed = [replace(item, x=below.x, y=below.y) for item, below in zip(objects, bases, strict=True)]
    return with_supports(placed, carried_by)


def _demand(kinds: tuple[str, ...]) -> tuple[int, int]:
    return len(kinds), kinds.count("bowl")
