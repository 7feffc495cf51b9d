"""The parser that has learned to see: what its votes mean, how they become objects, how slots follow them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tests.textocvp.conftest import VOTES, build
from textocvp.config import ModelConfig
from textocvp.parsers.votes import VotesConfig, VotesParser, count_votes, vote_loss, vote_targets
from textocvp.slots import SlotState

RED, BLUE, GREEN = (255, 87, 89), (78, 121, 167), (89, 161, 79)
TABLE, ARM = (47, 47, 47), (120, 120, 120)


def perfect(labels_NHW: Tensor) -> tuple[Tensor, Tensor]:
    """What a network says that is never wrong."""
    targets = vote_targets(labels_NHW)
    return 9.0 * F.one_hot(targets.classes_NHW, 3).permute(0, 3, 1, 2).float(), targets.votes_N3HW


def scene(*boxes: tuple[int, int, int, int, int], size: int = 32) -> Tensor:
    """Labels (1, size, size) of boxes (label, top, left, height, width), the later over the earlier."""
    labels_HW = torch.zeros(size, size, dtype=torch.uint8)
    for label, top, left, height, width in boxes:
        labels_HW[top : top + height, left : left + width] = label
    return labels_HW[None]


class Oracle(nn.Module):
    """Stands for the network: knows the labels of the frames that it will be shown, one after another."""

    def __init__(self, labels: list[Tensor]) -> None:
        super().__init__()
        self.labels = iter(labels)

    def forward(self, frames_N3HW: Tensor) -> tuple[Tensor, Tensor]:
        return perfect(next(self.labels).expand(len(frames_N3HW), -1, -1))


def parse(labels: list[Tensor], colors: dict[int, tuple[int, int, int]]) -> tuple[Tensor, SlotState]:
    """Winners (T, H, W) and slots (1, T, K) of a clip of these labels, painted in these colours."""
    palette = torch.zeros(256, 3)
    for label, color in {0: TABLE, 1: ARM, **colors}.items():
        palette[label] = torch.tensor(color, dtype=torch.float32)
    frames_1T3HW = palette[torch.cat(labels).long()].permute(0, 3, 1, 2)[None] / 127.5 - 1
    parser = build(VOTES).parser
    parser.network = Oracle(labels)
    with torch.no_grad():
        parsed = parser(frames_1T3HW)
    return parsed.attention_BTKHW[0].argmax(1), SlotState.split(parsed.slots_BTKD, VOTES.parser.layout)


def test_targets_move_and_mirror_with_the_picture() -> None:
    labels = scene((2, 8, 9, 6, 4), (3, 12, 11, 5, 7), (1, 0, 20, 9, 3))
    plain, moved = vote_targets(labels), vote_targets(labels.roll((3, 2), (1, 2)))
    objects = labels > 0
    torch.testing.assert_close(
        moved.votes_N3HW.roll((-3, -2), (2, 3))[:, :, objects[0]], plain.votes_N3HW[:, :, objects[0]], atol=1e-3, rtol=0
    )
    mirrored = vote_targets(labels.flip(2)).votes_N3HW.flip(3)[:, :, objects[0]]
    torch.testing.assert_close(
        mirrored * torch.tensor([-1.0, 1, 1])[:, None], plain.votes_N3HW[:, :, objects[0]], atol=1e-3, rtol=0
    )
    assert plain.area_NHW[0, 8, 9] == (labels == 2).sum() and plain.classes_NHW[0, 0, 20] == 2


def test_the_network_moves_with_the_picture() -> None:
    """By multiples of its coarsest cell, 16 pixels, away from the borders."""
    parser = build(VOTES).parser
    torch.manual_seed(0)
    for weights in parser.network.parameters():
        weights.data = 0.2 * torch.randn_like(weights)
    frames = torch.zeros(1, 3, 320, 320)
    frames[..., 144:160, 144:160] = torch.randn(3, 16, 16)
    with torch.no_grad():
        plain, moved = parser.network(frames), parser.network(frames.roll((16, 32), (2, 3)))
    for one, other in zip(plain, moved, strict=True):
        torch.testing.assert_close(
            other.roll((-16, -32), (2, 3))[..., 140:164, 140:164], one[..., 140:164, 140:164], atol=1e-3, rtol=1e-3
        )
        assert one[..., 140:164, 140:164].std() > 0.01


@pytest.mark.parametrize(
    "boxes",
    [((2, 8, 8, 5, 5), (3, 8, 13, 5, 5)), ((2, 6, 6, 14, 14), (3, 10, 10, 6, 6))],
    ids=["side by side", "a block in the middle of a bowl"],
)
def test_touching_objects_are_told_apart_by_their_votes(boxes: tuple) -> None:
    labels = scene(*boxes, (4, 25, 25, 2, 2), (1, 0, 20, 5, 5))
    (logits,), (votes,) = perfect(labels)
    ballot = count_votes(logits, votes, most=6)
    assert len(ballot.peaks_P3) == 3
    winner, truth = ballot.elect(ballot.peaks_P3), labels[0][ballot.y_L, ballot.x_L]
    for label in (2, 3, 4):
        assert len(winner[truth == label].unique()) == 1
    assert len(winner.unique()) == 3


def test_a_carried_object_keeps_its_slot_past_another_of_its_colour() -> None:
    labels = [scene((2, 14, 18, 6, 6), (3, 10, 2 + 3 * t, 5, 5), (1, 0, 3 + 3 * t, 10, 3)) for t in range(9)]
    winners, state = parse(labels, {2: RED, 3: RED})
    for t, truth in enumerate(labels):
        for label in (1, 2, 3):
            slot = winners[0][labels[0][0] == label].unique()
            assert len(slot) == 1 and (winners[t][truth[0] == label] == slot).all()
    assert state.presence[0, :, :, 0].tolist() == [[2, 1, 1, 1, 0, 0]] * 9


def test_a_scrap_does_not_turn_a_thing_away_from_its_slot() -> None:
    """Else the scrap would be the one thing, and this one its hidden neighbour: one thing more would be explained."""
    thing, hidden, scrap = (2, 12, 12, 7, 7), (1, 0, 19, 32, 9), (4, 14, 9, 2, 2)
    winners, _ = parse([scene(thing, (3, 12, 20, 7, 7)), scene(thing, hidden, scrap)], {2: RED, 3: RED, 4: RED})
    assert (winners[:, 12:19, 12:19] == winners[0, 15, 15]).all()


def test_a_scrap_at_the_robot_is_its_tool_and_elsewhere_a_thing() -> None:
    arm, tool, small, later = (1, 0, 10, 14, 4), (2, 15, 11, 3, 2), (3, 26, 26, 3, 3), (4, 4, 15, 2, 3)
    winners, state = parse([scene(arm, tool, small), scene(arm, tool, small, later)], {2: BLUE, 3: RED, 4: RED})
    assert (winners[:, 15:18, 11:13] == 1).all() and (winners[1, 4:6, 15:18] == 1).all()
    assert (winners[:, 26:29, 26:29] == 2).all()
    assert state.presence[0, :, :, 0].tolist() == [[2, 1, 1, 0, 0, 0]] * 2


def test_a_hidden_object_keeps_its_slot_and_what_appears_takes_a_free_one() -> None:
    hidden = (1, 0, 0, 32, 16)
    labels = [
        scene((2, 4, 4, 5, 5), (3, 20, 20, 5, 5)),
        scene((2, 4, 4, 5, 5), (3, 20, 20, 5, 5), hidden),
        scene((2, 4, 4, 5, 5), (3, 20, 20, 5, 5), (4, 10, 20, 5, 5), (5, 28, 4, 3, 3)),
    ]
    winners, state = parse(labels, {2: BLUE, 3: RED, 4: BLUE, 5: RED})
    assert winners[0, 5, 5] == winners[2, 5, 5] and winners[0, 21, 21] == winners[2, 21, 21]
    assert winners[2, 11, 21] == 4
    assert winners[2, 29, 5] == 0  # too small to be something new
    slot = int(winners[0, 5, 5])
    assert torch.equal(state.position[0, 1, slot], state.position[0, 0, slot])
    assert state.presence[0, :, :, 0].sum(1).tolist() == [4, 5, 6]  # the robot comes, then the fourth thing


def test_what_comes_late_beside_the_robot_is_its_tool_until_it_is_as_large_as_a_thing() -> None:
    arm, thing = (1, 0, 10, 14, 4), (2, 24, 24, 5, 5)
    labels = [
        scene(arm, thing),
        scene(arm, thing, (3, 15, 10, 5, 5)),  # the tool, seen from near
        scene(arm, thing, (3, 15, 10, 7, 8)),
        scene(arm, thing, (3, 0, 24, 5, 5)),
    ]
    winners, state = parse(labels, {2: BLUE, 3: RED})
    assert [int(winners[t, y, x]) for t, y, x in ((1, 17, 12), (2, 18, 14), (3, 2, 26))] == [1, 3, 3]
    assert state.presence[0, :, 3, 0].tolist() == [0, 0, 1, 1]


def test_what_appears_far_away_is_a_thing_that_was_lost_if_it_looks_like_it() -> None:
    labels = [scene((2, 2, 2, 5, 5), (3, 20, 20, 5, 5)), scene((3, 20, 20, 5, 5), (4, 24, 2, 5, 5), (5, 2, 25, 5, 5))]
    winners, _ = parse(labels, {2: RED, 3: BLUE, 4: RED, 5: GREEN})
    assert winners[1, 26, 4] == winners[0, 4, 4]
    assert winners[1, 4, 27] == 4  # this one looks like nothing that was


def test_sizes_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="num_slots is 1: background and robot take 2"):
        build(VOTES).parser(torch.zeros(1, 1, 3, 32, 32), num_slots=1)
    with pytest.raises(ValueError, match=r"parser\.image_size is 33: .* squares of 2x2 pixels"):
        replace(VOTES.parser, image_size=33)


def test_clips_parsed_together_are_parsed_as_alone() -> None:
    torch.manual_seed(1)
    clips = torch.rand(3, 3, 3, 32, 32) * 2 - 1
    parser = build(VOTES).parser
    with torch.no_grad():
        together = parser(clips).slots_BTKD
        for index in range(3):
            alone = parser(clips[index : index + 1, :2]).slots_BTKD[0]
            torch.testing.assert_close(together[index, :2], alone, atol=1e-4, rtol=1e-4)


def test_slots_are_made_where_the_frames_are_whatever_the_default_device_is() -> None:
    """On a GPU a tensor that was made without a device would be on the other one."""
    torch.manual_seed(1)
    clips = torch.rand(2, 3, 3, 32, 32) * 2 - 1
    parser = build(VOTES).parser
    with torch.no_grad():
        found = parser(clips).slots_BTKD
        with torch.device("meta"):
            assert torch.equal(parser(clips).slots_BTKD, found)


def test_the_lesson_is_over_when_nothing_is_wrong() -> None:
    labels = scene((2, 8, 8, 5, 5), (3, 8, 13, 5, 5), (1, 0, 20, 9, 3))
    logits, votes = perfect(labels)
    right, fat = vote_loss(logits, votes, vote_targets(labels)), logits.clone()
    fat[:, 1, 7] += 18  # a row of the table taken for an object
    assert right < 0.01 < vote_loss(fat, votes, vote_targets(labels))
    assert vote_loss(logits, votes + 4, vote_targets(labels)) > 1


def test_every_weight_of_the_network_learns_from_the_lesson() -> None:
    parser = build(VOTES).parser
    parser.lesson_loss(torch.rand(2, 3, 32, 32), scene((2, 8, 8, 5, 5)).expand(2, -1, -1)).backward()
    assert all(weights.grad is not None for weights in parser.network.parameters())


def test_configuration_comes_back_from_a_dictionary_and_needs_room_for_an_object() -> None:
    assert ModelConfig.from_dict(VOTES.to_dict()) == VOTES
    assert isinstance(build(VOTES).parser, VotesParser)
    with pytest.raises(ValueError, match=r"num_slots must be 3 .* to 1000, not 2"):
        VotesConfig(num_slots=2)
