"""Stage 2: it learns, continues exactly, recolours consistently, and measures what it says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.textocvp.conftest import PLACED, PUBLISHED, build
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp.config import ModelConfig
from textocvp.data.episodes import EpisodeFile
from textocvp.data.slot_batches import SlotBatches
from textocvp.data.slot_cache import SlotCache
from textocvp.model import TextOCVP
from textocvp.predictors.ocvp_seq import OCVPSeqConfig
from textocvp.slots import SlotLayout, SlotState
from textocvp.text import build_text_encoder
from textocvp.text.words import WordsConfig
from textocvp.training import run as training
from textocvp.training.evaluate_predictor import FollowingTest, Thing, ask, things_of
from textocvp.training.losses import moving_weights, slot_loss
from textocvp.training.predictor import (
    Lesson,
    PredictorStage,
    PredictorTraining,
    next_lesson,
    train,
    true_frames,
)
from textocvp.world_model import WorldModel

LAYOUT = SlotLayout(content=4)
OCVP_SEQ = replace(
    PLACED,
    name="tiny-ocvp-seq",
    predictor=OCVPSeqConfig(dim=16, layers=2, heads=2, hidden=16, attention="causal", window=8),
)


def scenes(episodes: int = 12, frames: int = 6, slots: int = 5) -> SlotCache:
    """Slots of scenes in which slot 1 moves right; slot 0 is the canvas, the last one is unused."""
    rng = np.random.default_rng(0)
    state = SlotState(
        torch.from_numpy(rng.normal(size=(episodes, frames, slots, 4)).astype(np.float32)),
        torch.from_numpy(rng.uniform(-1, 1, size=(episodes, 1, slots, 3)).astype(np.float32)).repeat(
            1, frames, 1, 1
        ),
        torch.from_numpy(rng.uniform(-0.5, 0.5, size=(episodes, 1, slots, 2)).astype(np.float32)).repeat(
            1, frames, 1, 1
        ),
        torch.full((episodes, frames, slots, 2), 0.1),
        torch.ones(episodes, frames, slots, 1),
    )
    state.position[:, :, 1, 0] += torch.arange(frames) * 0.05
    state.presence[:, :, 0] = 2
    state.presence[:, :, -1] = 0
    slots_NKD = state.join().flatten(0, 1).half().numpy()
    texts = ["put the red block in the blue bowl", "put the green block in the gray bowl"] * (episodes // 2)
    return SlotCache(slots_NKD, np.arange(episodes + 1) * frames, texts, "", "")


def batches(**changes) -> SlotBatches:
    settings = dict(recolor=True, color_spread=0.0, color_jitter=0.0, place_jitter=0.0) | changes
    return SlotBatches(scenes(), LAYOUT, build(PLACED).text, 6, **settings)


@pytest.fixture
def run(tmp_path: Path):
    """Arguments of a tiny stage 2 over toy episodes."""

    def arguments(config: ModelConfig, out: str, **changes) -> PredictorTraining:
        parser = tmp_path / config.name
        if not parser.exists():
            build(config).save_pretrained(parser)
            write_toy_episodes(tmp_path / "train.h5", [9, 8, 9, 9])
            write_toy_episodes(tmp_path / "val.h5", [9, 9], seed=1)
        settings = dict(steps=4, batch=3, warmup=1, autoregressive=0.5, horizon=2, evaluate_every=100)
        data = dict(data=tmp_path / "train.h5", val=tmp_path / "val.h5", out=tmp_path / out)
        return PredictorTraining(parser=parser, **data, **(settings | changes))

    return arguments


def weights(out: Path) -> dict[str, torch.Tensor]:
    return TextOCVP.from_pretrained(out / "checkpoint").state_dict()


@pytest.mark.parametrize("config", [PLACED, PUBLISHED, OCVP_SEQ], ids=lambda config: config.name)
def test_a_killed_run_continues_exactly(run, config, monkeypatch):
    straight, resumed = run(config, "straight"), run(config, "resumed", save_minutes=0.0)
    train(straight)

    save, lost = training.save_state, []

    def killed_after_two(accelerator, out, next_step):
        save(accelerator, out, next_step)
        if next_step == 2 and not lost:
            lost.append(True)
            raise KeyboardInterrupt

    monkeypatch.setattr(training, "save_state", killed_after_two)
    with pytest.raises(KeyboardInterrupt):
        train(resumed)
    torch.rand(7)  # the world goes on
    train(resumed)
    assert lost
    a, b = weights(straight.out), weights(resumed.out)
    assert all(torch.equal(a[name], b[name]) for name in a)
    changed = {
        name.split(".")[0]
        for name, tensor in build(config).state_dict().items()
        if not torch.equal(a[name], tensor)
    }
    assert changed == {"text", "predictor"}  # parser and renderer are frozen


def test_a_checkpoint_knows_how_far_it_was_trained(run):
    args = run(PLACED, "run")
    TextOCVP(replace(build(PLACED).config, stage="parser")).save_pretrained(args.parser)
    with pytest.raises(training.SettingsError, match="no trained predictor to finetune"):
        train(replace(args, finetune=True))
    with pytest.warns(UserWarning, match="first stage of training only"):
        WorldModel.from_pretrained(args.parser).rollout(
            np.zeros((32, 32, 3), np.uint8), "put the red block in the blue bowl", horizon=1
        )
    train(args)
    assert TextOCVP.from_pretrained(args.out / "checkpoint").config.stage == "predictor"


def test_settings_that_do_not_fit_are_said_before_anything_is_parsed(run):
    args = run(PLACED, "run")
    for setting, words in (
        ("text.kind=transformer", r"set predictor\.color_bias=false"),
        ("predictor.layer=2", r"predictor has no field 'layer'"),
        ("predictor.heads=3", "heads"),
    ):
        with pytest.raises(training.SettingsError, match=words):
            train(replace(args, set=(setting,)))
    larger = replace(PLACED, name="larger", parser=replace(PLACED.parser, image_size=64))
    build(larger).save_pretrained(args.parser)
    with pytest.raises(training.SettingsError, match=r"frames of 32 pixels, parser\.image_size is 64"):
        train(args)
    assert not list(args.out.glob("slots-*"))


def test_nothing_teaches_a_text_encoder_that_nobody_hears(run):
    train(run(OCVP_SEQ, "short", steps=1))
    train(run(OCVP_SEQ, "long", steps=3))
    a, b = (weights(run(OCVP_SEQ, name).out) for name in ("short", "long"))
    assert {name.split(".")[0] for name in a if not torch.equal(a[name], b[name])} == {"predictor"}


def test_image_loss_reaches_the_predictor_through_the_frozen_renderer(run):
    train(run(PLACED, "without", autoregressive=1.0))
    train(run(PLACED, "with", autoregressive=1.0, image_weight=100.0))
    a, b = (weights(run(PLACED, name).out) for name in ("without", "with"))
    assert any(not torch.equal(a[name], b[name]) for name in a if name.startswith("predictor"))
    assert all(torch.equal(a[name], b[name]) for name in a if name.startswith(("parser", "renderer")))


def test_options_replace_the_checkpoints_choices(run):
    settings = ("predictor.color_bias=false", "text.kind=transformer", "predictor.window=6")
    train(run(PLACED, "out", set=settings, steps=1))
    config = TextOCVP.from_pretrained(run(PLACED, "out").out / "checkpoint").config
    assert (config.predictor.color_bias, config.text.kind, config.predictor.window) == (
        False,
        "transformer",
        6,
    )
    assert config.parser == PLACED.parser


def test_imagined_part_grows_to_the_whole_episode_and_every_frame_is_trained():
    args = PredictorTraining(Path(), Path(), Path(), parser=Path(), steps=1000, autoregressive=0.4, horizon=4)
    given = [
        next_lesson(args, PLACED.predictor, step, 25, np.random.default_rng(step)) for step in range(1000)
    ]
    assert all(lesson == Lesson(24, 0) for lesson in given[:600])
    assert max(lesson.imagined for lesson in given[600:615]) <= 4
    assert Lesson(1, 23) in given[930:]
    assert all(lesson.seen + lesson.imagined == 24 for lesson in given)
    published = [
        next_lesson(args, PUBLISHED.predictor, step, 25, np.random.default_rng(step)) for step in range(1000)
    ]
    assert all(lesson.seen >= 1 and lesson.seen + lesson.imagined <= 24 for lesson in published)
    assert {lesson.imagined for lesson in published[:20]} <= {1, 2, 3, 4}


def test_imagined_frames_are_the_rollout_and_each_predicts_the_next():
    model, slots = build(PLACED), batches().draw(np.random.default_rng(0), 3)
    model = build(replace(PLACED, parser=replace(PLACED.parser, layout=LAYOUT)))
    dynamics = PredictorStage(model)
    predicted = dynamics(slots.slots_BTKD[:, :2], slots.words, 3)
    with torch.no_grad():
        text = model.text.encode(slots.words)
        imagined = model.predictor.rollout(slots.slots_BTKD[:, :2], text, 4).slots_BSKD
    assert predicted.shape[1] == 5  # of frames 1 to 5
    torch.testing.assert_close(predicted[:, 1:], imagined, atol=1e-5, rtol=1e-4)
    predicted[:, -1].sum().backward()
    assert model.predictor.slot_out.weight.grad.abs().max() > 0


def test_recoloring_permutes_scene_and_words_alike():
    plain, recolored = batches(recolor=False), batches()
    a, b = plain.draw(np.random.default_rng(5), 12), recolored.draw(np.random.default_rng(5), 12)
    assert (a.episodes_B == b.episodes_B).all()
    before, after = SlotState.split(a.slots_BTKD, LAYOUT), SlotState.split(b.slots_BTKD, LAYOUT)
    assert len({tuple(order.tolist()) for order in b.channels_B3}) > 2
    for i, order in enumerate(b.channels_B3):
        torch.testing.assert_close(after.color[i], before.color[i][..., order])
        torch.testing.assert_close(b.words.colors_BL3[i], a.words.colors_BL3[i][..., order])
    assert torch.equal(after.content, before.content) and torch.equal(after.position, before.position)


def test_words_without_rgb_stop_all_recoloring():
    """Else "red" would be taught to mean whatever colour the red block was given."""
    text = build_text_encoder(WordsConfig(kind="transformer", dim=16, heads=2, hidden=16))
    plain, asked = (
        SlotBatches(scenes(), LAYOUT, text, 6, color_jitter=0.0, place_jitter=0.0, **settings)
        for settings in (dict(recolor=False, color_spread=0.0), dict(recolor=True, color_spread=0.5))
    )
    a, b = (source.draw(np.random.default_rng(5), 12) for source in (plain, asked))
    assert torch.equal(a.slots_BTKD, b.slots_BTKD)
    assert torch.equal(b.channels_B3, torch.arange(3).expand(12, 3))  # the frames of an image loss stay, too
    jittered = SlotBatches(
        scenes(), LAYOUT, text, 6, recolor=True, color_spread=0.5, color_jitter=0.1, place_jitter=0.0
    ).draw(np.random.default_rng(5), 12)
    assert jittered.words.colors_BL3.abs().max() == 0


def test_spread_keeps_the_match_of_slots_and_words():
    plain, spread = batches(recolor=False), batches(recolor=False, color_spread=0.3)
    a, b = plain.draw(np.random.default_rng(5), 12), spread.draw(np.random.default_rng(5), 12)
    before, after = SlotState.split(a.slots_BTKD, LAYOUT).color, SlotState.split(b.slots_BTKD, LAYOUT).color
    red = a.words.names_color_BL[:, 2]
    assert red.all() and (b.words.colors_BL3[~b.words.names_color_BL] == 0).all()
    # One stretch a scene and channel: what differs between slot and word differs alike afterwards.
    gap_before = before[:, 0, 1] - a.words.colors_BL3[:, 2]
    ratio = (after[:, 0, 1] - b.words.colors_BL3[:, 2]) / gap_before
    other = (after[:, 0, 2] - b.words.colors_BL3[:, 2]) / (before[:, 0, 2] - a.words.colors_BL3[:, 2])
    torch.testing.assert_close(ratio, other, atol=1e-3, rtol=1e-3)
    assert ratio.min() >= 0.69 and ratio.max() <= 1.31 and ratio.std() > 0.05


def test_unused_slots_are_left_out_and_colors_stay_those_of_the_first_frame():
    drawn = batches(color_jitter=0.1).draw(np.random.default_rng(0), 4)
    state = SlotState.split(drawn.slots_BTKD, LAYOUT)
    assert drawn.slots_BTKD.shape[2] == 4
    assert (state.presence >= 0.5).all()
    assert torch.equal(state.color, state.color[:, :1].expand_as(state.color))


def test_place_noise_spares_the_canvas():
    source = batches(place_jitter=0.1)
    slots = source.draw(np.random.default_rng(0), 4).slots_BTKD
    moved = (source.noisy(np.random.default_rng(1), slots) - slots).abs().amax(dim=(0, 1))
    canvas = SlotState.split(slots, LAYOUT).presence[0, 0, :, 0] > 1.5
    assert moved[canvas].max() == 0 and moved[~canvas, 7:9].min() > 0
    assert moved[:, :7].max() == 0 and moved[:, 9:].max() == 0


def test_moving_slots_weigh_more_and_unused_ones_nothing():
    slots = scenes().padded(8).float()  # 6 frames, then still
    step = moving_weights(slots, LAYOUT, 20.0, ever=False)
    assert step[0, :, 1].tolist() == [20.0] * 5 + [1.0] * 2
    assert (step[:, :, 2] == 1).all() and (step[:, :, -1] == 0).all()
    ever = moving_weights(slots, LAYOUT, 20.0, ever=True)
    assert ever[0, :, 1].tolist() == [20.0] * 7


def test_loss_counts_each_field_in_its_own_unit():
    slots = scenes().padded(6).float()[:, :1]
    std, weight = torch.tensor([1.0, 2.0, 1.0, 1.0]), torch.zeros(12, 1, 5)
    weight[:, :, 1] = 1.0
    assert sum(slot_loss(slots, slots, weight, LAYOUT, std).figures().values()) == 0
    state = SlotState.split(slots, LAYOUT)
    shifted = replace(state, position=state.position + torch.tensor([0.3, 0.0]))
    assert slot_loss(shifted.join(), slots, weight, LAYOUT, std).position.item() == pytest.approx(
        9.5, abs=0.01
    )
    wider = replace(state, scale=state.scale * np.exp([0.1, 0.0], dtype=np.float32))
    assert slot_loss(wider.join(), slots, weight, LAYOUT, std).scale.item() == pytest.approx(1.0, abs=0.01)
    other = replace(state, content=state.content + torch.tensor([0.0, 2.0, 0.0, 0.0]))
    assert slot_loss(other.join(), slots, weight, LAYOUT, std).content.item() == pytest.approx(0.25, abs=0.01)


def test_frames_of_the_image_loss_are_the_recolored_ones(tmp_path):
    with EpisodeFile(write_toy_episodes(tmp_path / "toy.h5", [6, 4])) as episodes:
        batch = replace(batches().draw(np.random.default_rng(0), 2), episodes_B=np.array([1, 0]))
        batch = replace(batch, channels_B3=torch.tensor([[2, 1, 0], [0, 1, 2]]))
        frames = true_frames(episodes, batch, np.array([[1, 9], [0, 5]]))
        clips = [torch.from_numpy(episodes.episode(i).frames).permute(0, 3, 1, 2) / 127.5 - 1 for i in (1, 0)]
        torch.testing.assert_close(frames[0, 0], clips[0][1].flip(0))
        torch.testing.assert_close(
            frames[0, 1], clips[0][3].flip(0)
        )  # a short episode stays in its last frame
        torch.testing.assert_close(frames[1, 1], clips[1][5])


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


def test_following_asks_and_judges():
    slots = scenes().padded(6).float()[:1]
    place = SlotState.split(slots[0, 0], LAYOUT).position
    things = [
        Thing("block", "red", tuple(place[1].tolist()), (0.1, 0.1), True),
        Thing("bowl", "blue", tuple(place[2].tolist()), (0.1, 0.1), True),
        Thing("bowl", "green", tuple(place[3].tolist()), (0.1, 0.1), False),
    ]
    question = ask(things, slots[0, 0], LAYOUT, np.random.default_rng(0))
    assert (question.block, question.bowl, question.other_bowl) == (1, 2, 3)
    original, other = "put the red block in the blue bowl", "put the red block in the green bowl"
    assert (question.original, question.other, question.wrong) == (original, other, other)
    test = FollowingTest(slots, [question], LAYOUT)
    model = _Obedient({original: (1, 2), other: (1, 3)})
    obedient = test.measure(model)
    assert model.training
    assert (obedient.original, obedient.other_bowl, obedient.wrong_text, obedient.grounded) == (1, 1, 0, 1)
    deaf = test.measure(_Obedient({original: (1, 2), other: (1, 2)}))
    assert (deaf.original, deaf.other_bowl, deaf.wrong_text) == (1, 0, 1)

    far = replace(things[0], place=(0.9, 0.9))
    lost = ask([far, *things[1:]], slots[0, 0], LAYOUT, np.random.default_rng(0))
    assert lost.block == -1
    nobody = FollowingTest(slots, [lost], LAYOUT).measure(_Obedient({original: (1, 2), other: (1, 3)}))
    assert (nobody.original, nobody.grounded) == (0, 0)


def test_a_block_in_a_bowl_is_told_from_the_bowl_by_its_size():
    slots = scenes().padded(1).float()[0, 0]
    state = SlotState.split(slots, LAYOUT)
    state.position[3] = state.position[2]  # views: slots changes too
    state.scale[2], state.scale[3] = 0.1, 0.04
    place = tuple(state.position[2].tolist())
    bowl, block = (
        Thing("bowl", "blue", place, (0.11, 0.1), True),
        Thing("block", "red", place, (0.04, 0.04), True),
    )
    question = ask([bowl, block], slots, LAYOUT, np.random.default_rng(0))
    assert (question.block, question.bowl) == (3, 2)


def test_things_are_where_the_simulator_saw_them_first(tmp_path):
    with EpisodeFile(write_toy_episodes(tmp_path / "toy.h5", [6])) as episodes:
        things = things_of(episodes.episode(0))
        mask = episodes.episode(0).segmentation[0] == 4
    assert [thing.kind for thing in things] == ["block", "block", "bowl", "bowl"]
    assert [thing.named for thing in things] == [True, False, True, False]
    y, x = np.argwhere(mask).mean(axis=0) + 0.5
    assert things[2].place == pytest.approx((x / 16 - 1, y / 16 - 1), abs=1e-5)
    assert things[3].size == pytest.approx((9**2 / 12 - 1 / 12) ** 0.5 / 16 * np.ones(2), abs=0.02)
