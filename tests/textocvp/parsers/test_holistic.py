"""Non-OC: a frame is one slot, from the parser to the front door."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from tests.textocvp.conftest import NON_OC, build
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp import WorldModel, cli
from textocvp.config import with_settings
from textocvp.model import TextOCVP
from textocvp.presets import PRESETS, preset

TEXT = "put the red block in the blue bowl"


@pytest.fixture
def model() -> TextOCVP:
    return build(NON_OC)


def test_the_published_predictor_has_the_published_size():
    with torch.device("meta"):
        model = TextOCVP(preset("non-oc"))
        savi = TextOCVP(preset("savi-cater"))
    assert sum(p.numel() for p in model.predictor.parameters()) == 34_155_008
    assert sum(p.numel() for p in savi.predictor.parameters()) == 33_761_408
    assert model.predictor.config == savi.predictor.config


def test_every_frame_is_parsed_alone_and_places_in_it_matter(model: TextOCVP, scene: np.ndarray):
    frame = torch.from_numpy(scene).permute(2, 0, 1) / 127.5 - 1
    clip_12 = torch.stack([frame, frame.flip(-1)])[None].float()
    parsed = model.parser(clip_12)
    assert parsed.slots_BTKD.shape == (1, 2, 1, 24) and parsed.expected_BTKD is None
    torch.testing.assert_close(parsed.attention_BTKHW.sum(2), torch.ones(1, 2, 4, 4))
    backwards = model.parser(clip_12.flip(1)).slots_BTKD
    torch.testing.assert_close(backwards.flip(1), parsed.slots_BTKD)
    whole = build(replace(NON_OC, parser=replace(NON_OC.parser, pool_cells=1))).parser(clip_12).slots_BTKD
    for slots in (parsed.slots_BTKD, whole):
        assert (slots[:, 0] - slots[:, 1]).abs().max() > 1e-3


@pytest.mark.parametrize("size", [16, 32, 64])
def test_the_one_mask_is_the_whole_frame(size: int):
    config = replace(NON_OC, parser=replace(NON_OC.parser, image_size=size))
    rendered = build(config).renderer(torch.randn(3, 1, 24))
    assert rendered.frames_B3HW.shape == (3, 3, size, size)
    assert torch.equal(rendered.masks_BKHW, torch.ones(3, 1, size, size))
    assert torch.equal(rendered.draw_objects()[:, 0], rendered.frames_B3HW)


def test_it_is_used_like_every_model(model: TextOCVP, scene: np.ndarray, tmp_path: Path):
    world_model = WorldModel(model)
    rollout = world_model.rollout(scene, [TEXT, "put the blue block in the red bowl"], horizon=8)
    assert rollout.frames.shape == (2, 9, 3, 32, 32) and rollout.masks.shape == (2, 9, 1, 32, 32)
    assert (rollout.slots[0, 1:] - rollout.slots[1, 1:]).abs().max() > 1e-4  # it hears the text
    assert world_model.longest_horizon == 8
    assert rollout.save(tmp_path / "imagined.png").stat().st_size > 0
    model.save_pretrained(tmp_path / "checkpoint")
    again = WorldModel.from_pretrained(tmp_path / "checkpoint").rollout(scene, TEXT, horizon=8)
    torch.testing.assert_close(again.slots[0], rollout.slots[0])


def test_what_does_not_fit_is_named():
    wrong = [
        ("parser.layout.explicit=true", "'holistic' needs parser.layout.explicit = false"),
        ("parser.num_slots=8", "1 slot, not parser.num_slots = 8"),
        ("parser.pool_cells=5", "pool_cells must be 1 to 4"),
        ("parser.image_size=48", "frames of 16, 32, 64, 128, ... pixels, not 48"),
        ("parser.image_size=8 parser.pool_cells=1", "not 8"),
        ("parser.kind=savi parser.num_slots=4", "'upsample' draws the one slot of a frame: set parser.kind=holistic"),
    ]
    for settings, message in wrong:
        with pytest.raises(ValueError, match=message):
            TextOCVP(with_settings(NON_OC, settings.split()))
    model = build(NON_OC)
    with pytest.raises(ValueError, match="sees a frame as one slot"):
        model.parser(torch.zeros(1, 1, 3, 32, 32), num_slots=2)
    with pytest.raises(ValueError, match="draws one slot, not 2"):
        model.renderer(torch.zeros(1, 2, 24))


def test_both_stages_train_it(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setitem(PRESETS, NON_OC.name, NON_OC)
    write_toy_episodes(tmp_path / "train.h5", [9, 8, 9, 9])
    data = ["--data", str(tmp_path / "train.h5"), "--val", str(tmp_path / "train.h5")]
    parser, predictor = tmp_path / "parser", tmp_path / "predictor"
    stage_1 = ["--preset", NON_OC.name, "--steps", "400", "--batch", "4", "--clip", "2"]
    stage_1 += ["--warmup", "10", "--learning-rate", "5e-3"]
    cli.main(["train", "parser", *data, "--out", str(parser), *stage_1, "--evaluate-every", "100"])
    printed = capsys.readouterr().out
    assert "one slot: there are no masks to measure" in printed and "not good enough" not in printed
    quality = json.loads((parser / "quality.json").read_text())
    assert quality["psnr"]["value"] > 19 and quality["object_miou"] is None  # the mean picture: 17.9
    assert iio.imread(parser / "samples" / "000100.png").shape == (4 * 2 * 32 * 2, 8 * 32 * 2, 3)

    stage_2 = ["--steps", "3", "--batch", "4", "--image-weight", "10", "--warmup", "1", "--horizon", "2"]
    stage_2 += ["--parser", str(parser / "checkpoint"), "--out", str(predictor)]
    assert cli.main(["train", "predictor", *data, *stage_2]) == 0
    a, b = (TextOCVP.from_pretrained(out / "checkpoint") for out in (parser, predictor))
    old, new = a.state_dict(), b.state_dict()
    changed = {name.split(".")[0] for name in old if not torch.equal(old[name], new[name])}
    assert changed == {"text", "predictor"}
    assert not torch.equal(new["predictor.content_std_C"], torch.ones(24))
