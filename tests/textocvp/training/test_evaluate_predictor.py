"""Instruction following: questions are asked of the data, and judged by where slots end."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.textocvp.conftest import PLACED, build
from tests.textocvp.slot_scenes import LAYOUT, true_slots
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp.data.cache import cached_slots
from textocvp.data.episodes import EpisodeFile, Question
from textocvp.slots import SlotLayout, SlotState
from textocvp.training.evaluate_predictor import PIXEL, HeldOut, Trial, Trials, place_and_size, slot_at


class _Obedient(torch.nn.Module):
    """Moves the block that a sentence names onto the bowl that it names, as an ideal model would."""

    device = torch.device("cpu")

    def __init__(self, places: dict[str, tuple[int, int]]) -> None:
        super().__init__()
        self.places = places

    def text(self, sentences):
        assert not self.training  # a fine-tuned T5 has dropout
        return list(sentences)

    @property
    def predictor(self):
        return self

    def rollout(self, seed_BTKD, text, steps):
        slots = seed_BTKD[:, -1:].repeat(1, steps, 1, 1)
        for b, sentence in enumerate(text):
            block, bowl = self.places[sentence]
            slots[b, -1, block] = slots[b, 0, bowl]
        from textocvp.predictors import Imagined

        return Imagined(slots)


def held_out(slots: torch.Tensor, trials: Trials, layout: SlotLayout = LAYOUT) -> HeldOut:
    return HeldOut(slots, ("a sentence",) * len(slots), layout, trials)


def asked(questions: list[Question], slot_of: dict[int, int]) -> Trials:
    trials = Trials()
    trials.add(0, questions[0], questions, slot_of, np.random.default_rng(0))
    return trials


BLUE, GREEN = Question("put it in the blue bowl", 7, 8), Question("put it in the green bowl", 7, 9)


def test_trials_ask_and_judge() -> None:
    slots = true_slots(6)[:1]
    trials = asked([BLUE, GREEN], {7: 1, 8: 2, 9: 3})
    assert trials.original == [Trial(0, BLUE.text, 1, 2)] and trials.other_target == [Trial(0, GREEN.text, 1, 3)]
    assert trials.wrong_text == [Trial(0, GREEN.text, 1, 2)]
    held, model = held_out(slots, trials), _Obedient({BLUE.text: (1, 2), GREEN.text: (1, 3)})
    obedient = held.measure(model)
    assert model.training
    assert (obedient.original, obedient.other_target, obedient.wrong_text, obedient.grounded) == (1, 1, 0, 1)
    deaf = held.measure(_Obedient({BLUE.text: (1, 2), GREEN.text: (1, 2)}))
    assert (deaf.original, deaf.other_target, deaf.wrong_text) == (1, 0, 1)

    nobody = held_out(slots, asked([BLUE, GREEN], {7: -1, 8: 2, 9: 3})).measure(model)
    assert (nobody.original, nobody.grounded, nobody.episodes) == (0, 0, 1) and np.isnan(nobody.error_px)
    assert held.measure(model, 0).episodes == 0
    assert asked([BLUE], {7: 1, 8: 2}).wrong_text == []  # there is nothing else to ask


def test_size_separates_an_object_from_the_one_that_it_lies_on() -> None:
    slots = true_slots(1)[0, 0]
    state = SlotState.split(slots, LAYOUT)
    state.position[3] = state.position[2]
    state.scale[2], state.scale[3] = 0.1, 0.04
    place = state.position[2]
    assert slot_at(state, place, torch.tensor([0.11, 0.1])) == 2
    assert slot_at(state, place, torch.tensor([0.04, 0.04])) == 3
    assert slot_at(state, torch.tensor([0.9, 0.9]), torch.tensor([0.1, 0.1])) == -1
    assert slot_at(state, *place_and_size(np.zeros((8, 8), bool))) == -1  # hidden


def test_places_and_sizes_are_those_of_masks(tmp_path: Path) -> None:
    with EpisodeFile(write_toy_episodes(tmp_path / "toy.h5", [6])) as episodes:
        mask = episodes.truth(0).segmentation[0] == 5
    place, size = place_and_size(mask)
    y, x = np.argwhere(mask).mean(axis=0) + 0.5
    assert place.tolist() == pytest.approx((x / 16 - 1, y / 16 - 1), abs=1e-5)
    assert size.tolist() == pytest.approx((9**2 / 12 - 1 / 12) ** 0.5 / 16 * np.ones(2), abs=0.02)


@pytest.mark.parametrize("version", [1, 2])
def test_questions_come_from_the_file(tmp_path: Path, version: int) -> None:
    path = write_toy_episodes(tmp_path / "toy.h5", [6, 5], version=version)
    model = build(PLACED)
    with EpisodeFile(path) as episodes:
        slots = cached_slots(model, episodes, tmp_path / "slots")
        trials = HeldOut.of(episodes, slots, model.config.parser.layout, 6).trials
        questions = [set(q.text for q in episodes.truth(index).questions) for index in range(2)]
    assert [trial.text for trial in trials.original] == list(episodes.instructions)
    assert [trial.episode for trial in trials.other_target] == [0, 1]
    for trial in (*trials.other_target, *trials.wrong_text):
        assert trial.text in questions[trial.episode] - {episodes.instructions[trial.episode]}


def test_nothing_is_asked_without_masks(tmp_path: Path) -> None:
    model = build(PLACED)
    with EpisodeFile(write_toy_episodes(tmp_path / "toy.h5", [6], truth=False)) as episodes:
        slots = cached_slots(model, episodes, tmp_path / "slots")
        held = HeldOut.of(episodes, slots, model.config.parser.layout, 6)
    assert held.trials == Trials() and held.file == "slot_errors.json"


class _Still(_Obedient):
    """Imagines that nothing moves."""

    def rollout(self, seed_BTKD, text, steps):
        from textocvp.predictors import Imagined

        return Imagined(seed_BTKD[:, -1:].repeat(1, steps, 1, 1))


def test_slot_errors_are_those_of_what_moves() -> None:
    slots = true_slots(6)
    found = held_out(slots, Trials()).measure(_Still({}), 5)
    # Slot 1 moves by 0.05 a frame: 0.15 from where it began, on average over five frames.
    assert found.error.value == pytest.approx(0.15 / PIXEL, rel=1e-2) and found.error == found.still_error
    assert found.error.n == 5 and "no masks and questions" in found.left_out
    assert set(found.as_metrics()) == {"val/error", "val/still_error"}
    unmoved = held_out(slots[:, :1].expand(-1, 6, -1, -1), Trials()).measure(_Still({}))
    assert unmoved.error is None and unmoved.as_metrics() == {}
    plain = SlotLayout(content=LAYOUT.dim, explicit=False)
    whole = held_out(slots, Trials(), plain).measure(_Still({}))
    expected = (slots[:, :1] - slots[:, 1:]).square().mean(dim=(1, 2, 3)).sqrt().mean()
    assert whole.error.value == pytest.approx(float(expected), rel=1e-5)
    assert "no explicit places" in whole.left_out
