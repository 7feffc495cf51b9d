"""Stage 2: it learns, continues exactly, and reports what it can."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from tests.textocvp.conftest import PLACED, PUBLISHED, build
from tests.textocvp.slot_scenes import LAYOUT, true_slots
from tests.textocvp.toy_episodes import write_toy_episodes
from tests.textocvp.training.runs import predictor_run, same_weights, train, train_killed_after, weights
from textocvp.checkpoint import CheckpointError
from textocvp.config import ModelConfig, PredictorConfig
from textocvp.model import TextOCVP
from textocvp.predictors.textocvp import TextOCVPConfig
from textocvp.training.evaluate_predictor import SlotErrors
from textocvp.training.predictor import PredictorStage, PredictorTraining, schedule
from textocvp.training.run import SettingsError
from textocvp.world_model import WorldModel

OCVP_SEQ = replace(
    PLACED,
    name="tiny-ocvp-seq",
    predictor=PredictorConfig(kind="ocvp-seq", dim=16, layers=2, heads=2, hidden=16, attention="causal", window=8),
)


def run(folder: Path, config: ModelConfig, out: str, **changes) -> PredictorTraining:
    """Arguments of a tiny stage 2 on a checkpoint of this configuration."""
    parser = folder / config.name
    if not parser.exists():
        build(config).save_pretrained(parser)
    settings = dict(parser=parser, steps=4, batch=3, autoregressive=0.5)
    return predictor_run(folder, out, **(settings | changes))


@pytest.mark.parametrize("config", [PLACED, PUBLISHED, OCVP_SEQ], ids=lambda config: config.name)
def test_a_killed_run_continues_exactly(folder: Path, config: ModelConfig) -> None:
    straight, resumed = (run(folder, config, name) for name in ("straight", "resumed"))
    train(straight)
    train_killed_after(resumed, 2)
    torch.rand(7)  # the world goes on
    train(resumed)
    assert same_weights(straight.out, resumed.out)
    trained = weights(straight.out)
    changed = {
        name.split(".")[0]
        for name, tensor in build(config).state_dict().items()
        if not torch.equal(trained[name], tensor)
    }
    assert changed == {"text", "predictor"}  # parser and renderer are frozen


def test_a_checkpoint_knows_how_far_it_was_trained(folder: Path) -> None:
    args = run(folder, PLACED, "run")
    TextOCVP(replace(build(PLACED).config, stage="parser")).save_pretrained(args.parser)
    with pytest.raises(SettingsError, match="no trained predictor to finetune"):
        train(replace(args, finetune=True))
    with pytest.warns(UserWarning, match="first stage of training only"):
        WorldModel.from_pretrained(args.parser).rollout(
            np.zeros((32, 32, 3), np.uint8), "put the red block in the blue bowl", horizon=1
        )
    train(args)
    assert TextOCVP.from_pretrained(args.out / "checkpoint").config.stage == "predictor"


def test_episodes_longer_than_the_window_are_not_cut_without_a_word(folder: Path) -> None:
    with pytest.warns(UserWarning, match=r"nothing is learned after frame 5, the longest has \d+; --set predictor"):
        train(run(folder, PLACED, "short", steps=1, set=("predictor.window=4",)))
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        train(run(folder, PLACED, "long", steps=1, set=("predictor.window=30",)))


def test_settings_that_do_not_fit_are_said_before_anything_is_parsed(folder: Path) -> None:
    args = run(folder, PLACED, "run")
    for setting, words in (
        ("text.kind=transformer", r"set predictor\.color_bias=false"),
        ("predictor.layer=2", "predictor has no field 'layer'"),
        ("predictor.heads=3", "heads"),
    ):
        with pytest.raises(SettingsError, match=words):
            train(replace(args, set=(setting,)))
    larger = replace(PLACED, name="larger", parser=replace(PLACED.parser, image_size=64))
    build(larger).save_pretrained(args.parser)
    with pytest.raises(SettingsError, match=r"frames of 32 pixels, parser\.image_size is 64"):
        train(args)
    assert not list(args.out.glob("slots-*"))


def test_nothing_trains_a_text_encoder_that_no_predictor_uses(folder: Path) -> None:
    train(run(folder, OCVP_SEQ, "short", steps=1))
    train(run(folder, OCVP_SEQ, "long", steps=3))
    a, b = (weights(run(folder, OCVP_SEQ, name).out) for name in ("short", "long"))
    assert {name.split(".")[0] for name in a if not torch.equal(a[name], b[name])} == {"predictor"}


def test_image_loss_reaches_the_predictor_through_the_frozen_renderer(folder: Path) -> None:
    train(run(folder, PLACED, "without", autoregressive=1.0))
    train(run(folder, PLACED, "with", autoregressive=1.0, image_weight=100.0))
    a, b = (weights(run(folder, PLACED, name).out) for name in ("without", "with"))
    assert any(not torch.equal(a[name], b[name]) for name in a if name.startswith("predictor"))
    assert all(torch.equal(a[name], b[name]) for name in a if name.startswith(("parser", "renderer")))


def test_options_replace_the_checkpoints_choices(folder: Path) -> None:
    settings = ("predictor.color_bias=false", "text.kind=transformer", "predictor.window=6")
    train(run(folder, PLACED, "out", set=settings, steps=1))
    config = TextOCVP.from_pretrained(run(folder, PLACED, "out").out / "checkpoint").config
    assert (config.predictor.color_bias, config.text.kind, config.predictor.window) == (False, "transformer", 6)
    assert config.parser == PLACED.parser


def test_a_parser_is_found_by_its_bundled_name(folder: Path) -> None:
    named = run(folder, PLACED, "named", parser="tabletop-smal")
    with pytest.raises(CheckpointError, match=r"unknown checkpoint 'tabletop-smal'.*tabletop-small"):
        train(named)
    with pytest.raises(SettingsError, match="frames of 32 pixels"):  # it was found: it reads larger frames
        train(replace(named, parser="tabletop-small"))


@pytest.mark.parametrize("config", [PLACED, PUBLISHED], ids=lambda config: config.name)
def test_frames_and_captions_are_enough(folder: Path, config: ModelConfig, capsys) -> None:
    for name, lengths in (("train", [9, 8, 9]), ("val", [9])):
        write_toy_episodes(folder / f"{name}.h5", lengths, truth=False)
    args = run(folder, config, "out", steps=2, evaluate_every=1)
    metrics = train(args)
    assert isinstance(metrics, SlotErrors) and metrics.error is not None
    assert capsys.readouterr().out.count("no instruction following") == 3
    assert json.loads((args.out / "slot_errors.json").read_text())["error"]["value"] == metrics.error.value


def test_words_come_from_the_training_file(folder: Path) -> None:
    """Of its vocabulary those that no caption contains are known to be untrained."""
    with h5py.File(folder / "train.h5", "a") as file:
        file.attrs["vocabulary"] = json.dumps(["put", "the", "block", "in", "bowl", "red", "beside"])
        file["episode/instruction"][0] = "push the red block"
    args = run(folder, PLACED, "out", steps=1)
    train(args)
    text = TextOCVP.from_pretrained(args.out / "checkpoint").config.text
    assert set(text.vocabulary) == {*PLACED.text.vocabulary, "beside", "push"}  # red has its RGB
    assert "beside" in text.untrained and not {"push", "put", "bowl"} & set(text.untrained)

    with h5py.File(folder / "train.h5", "a") as file:
        file["episode/instruction"][1] = "put the red block beside the blue bowl"
    tuned = replace(args, parser=args.out / "checkpoint", out=folder / "tuned", finetune=True)
    train(tuned)
    after = TextOCVP.from_pretrained(tuned.out / "checkpoint").config.text
    assert after.vocabulary == text.vocabulary and set(text.untrained) - set(after.untrained) == {"beside"}


def test_imagined_part_grows_to_the_whole_episode_and_every_frame_is_trained() -> None:
    args = PredictorTraining(Path(), Path(), Path(), parser=Path(), steps=1000, autoregressive=0.4, horizon=4)

    def schedules(attention: str, direct: bool = False) -> list[tuple[int, int]]:
        form = TextOCVPConfig(attention=attention, direct=direct)
        return [schedule(args, form, step, 25, np.random.default_rng(step)) for step in range(1000)]

    ours = schedules("causal")
    assert all(each == (24, 0) for each in ours[:600])
    assert max(imagined for _, imagined in ours[600:615]) <= 4
    assert (1, 23) in ours[930:]
    assert all(given + imagined == 24 for given, imagined in ours)
    assert set(schedules("causal", direct=True)) == {(1, 23)}
    published = schedules("window")
    assert all(given >= 1 and given + imagined <= 24 for given, imagined in published)
    assert {imagined for _, imagined in published[:20]} <= {1, 2, 3, 4}


@pytest.mark.parametrize("direct", [False, True])
def test_imagined_frames_are_the_rollout_and_each_predicts_the_next(direct: bool) -> None:
    predictor = replace(PLACED.predictor, direct=direct)
    model = build(replace(PLACED, parser=replace(PLACED.parser, layout=LAYOUT), predictor=predictor))
    slots_BTKD, words = true_slots(6)[:3], model.text.lookup(["put the red block in the blue bowl"] * 3)
    with torch.device("meta"):  # a default that fails wherever a tensor is made without a device, as on a GPU
        predicted, _ = PredictorStage(model)(slots_BTKD[:, :2], words, 3)
    with torch.no_grad():
        imagined = model.predictor.rollout(slots_BTKD[:, :2], model.text.encode(words), 4).slots_BSKD
    assert predicted.shape[1] == 5  # of frames 1 to 5
    torch.testing.assert_close(predicted[:, 1:], imagined, atol=1e-5, rtol=1e-4)
    predicted[:, -1].sum().backward()
    assert model.predictor.slot_out.weight.grad.abs().max() > 0
