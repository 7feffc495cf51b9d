"""The front door: what goes in, what comes out, and what is refused."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.textocvp.conftest import PLACED, PUBLISHED, build
from textocvp import Rollout, WorldModel
from textocvp.checkpoint import CheckpointError
from textocvp.inputs import ForeignPictureWarning
from textocvp.model import TextOCVP
from textocvp.presets import PRESETS
from textocvp.world_model import bundled_checkpoints

TEXT = "put the red block in the blue bowl"


def test_an_observation_becomes_a_rollout(world_model: WorldModel, scene: np.ndarray) -> None:
    rollout = world_model.rollout({"rgb": scene, "instruction": TEXT}, TEXT, horizon=3)
    K, D = world_model.model.config.parser.num_slots, world_model.model.parser.layout.dim
    assert rollout.slots.shape == (1, 4, K, D) and rollout.slots.dtype == torch.float32
    assert rollout.texts == (TEXT,) and rollout.image_size == (32, 32) and rollout.attention is None
    assert rollout.masks.shape == (1, 4, K, 32, 32) and rollout.frames.shape == (1, 4, 3, 32, 32)
    torch.testing.assert_close(rollout.masks.sum(2), torch.ones(1, 4, 32, 32))
    assert rollout.frames.min() >= 0 and rollout.frames.max() <= 1
    for name in ("slots", "masks", "frames", "positions", "colors", "presence"):
        assert not getattr(rollout, name).requires_grad and getattr(rollout, name).isfinite().all()


def test_the_first_frame_is_the_parsed_observation(world_model: WorldModel, scene: np.ndarray) -> None:
    rollout = world_model.rollout(scene, TEXT, horizon=2, seed=3)
    parsed = world_model.parse(scene[None], seed=3)
    assert parsed.texts == () and torch.equal(rollout.slots[:, 0], parsed.slots[:, 0])


def test_the_shipped_family_finds_the_squares(placed_world_model: WorldModel, scene: np.ndarray) -> None:
    parsed = placed_world_model.parse(scene[None])
    present = parsed.positions[0, 0][parsed.presence[0, 0] > 0.5]
    for centre in ([8.0, 7.0], [21.0, 23.0]):
        assert (present - torch.tensor(centre)).abs().amax(-1).min() < 0.3


def test_the_same_seed_gives_the_same_rollout(world_model: WorldModel, scene: np.ndarray) -> None:
    torch.manual_seed(1)
    a = world_model.rollout(scene, TEXT, horizon=3, seed=5)
    torch.manual_seed(2)
    b = world_model.rollout(scene, TEXT, horizon=3, seed=5)
    assert torch.equal(a.slots, b.slots)
    if world_model.model.config.parser.kind == "savi":
        assert not torch.allclose(a.slots, world_model.rollout(scene, TEXT, horizon=3, seed=6).slots, atol=1e-3)


def test_one_scene_and_many_texts_are_one_parse_and_one_batch(world_model: WorldModel, scene: np.ndarray) -> None:
    texts = [TEXT, "put the blue block in the red bowl", TEXT]
    parses: list[int] = []
    world_model.model.parser.register_forward_hook(lambda *_: parses.append(1))
    rollout = world_model.rollout(scene, texts, horizon=2)
    assert len(parses) == 1 and rollout.texts == tuple(texts) and len(rollout) == 3
    for i in (0, 1):
        alone = world_model.rollout(scene, texts[i], horizon=2)
        torch.testing.assert_close(rollout.slots[[i]], alone.slots, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(rollout.slots[0], rollout.slots[2], atol=1e-6, rtol=1e-5)


def test_scenes_and_texts_go_together(placed_world_model: WorldModel, scene: np.ndarray) -> None:
    scenes = np.stack([scene, scene[::-1], scene[:, ::-1]])
    texts = [TEXT, "put the blue block in the red bowl", TEXT]
    pairwise = placed_world_model.rollout(scenes, texts, horizon=2)
    one_text = placed_world_model.rollout({"rgb": scenes}, TEXT, horizon=2)
    assert one_text.texts == (TEXT,) * 3 and pairwise.texts == tuple(texts)
    for i in range(3):
        alone = placed_world_model.rollout(scenes[i], texts[i], horizon=2)
        torch.testing.assert_close(pairwise.slots[[i]], alone.slots, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(one_text.slots[0], pairwise.slots[0], atol=1e-5, rtol=1e-4)
    with pytest.raises(ValueError, match="3 scenes and 2 texts"):
        placed_world_model.rollout(scenes, texts[:2], horizon=2)


def test_a_rollout_goes_on_from_where_it_ended(world_model: WorldModel, scene: np.ndarray) -> None:
    first = world_model.rollout(scene, TEXT, horizon=2)
    then = world_model.rollout(first, [TEXT, "put the blue block in the red bowl"], horizon=3)
    assert then.slots.shape[:2] == (2, 4)
    assert torch.equal(then.slots[0, 0], first.slots[0, -1]) and torch.equal(then.slots[1, 0], first.slots[0, -1])
    again = world_model.rollout(first.last, [TEXT], horizon=3)
    torch.testing.assert_close(again.slots[0], then.slots[0], atol=1e-5, rtol=1e-4)


def test_a_rollout_of_another_model_is_refused(scene: np.ndarray) -> None:
    other = WorldModel(build(PUBLISHED)).rollout(scene, TEXT, horizon=1)
    with pytest.raises(ValueError, match="another model"):
        WorldModel(build(PLACED)).rollout(other, TEXT, horizon=2)


def test_cached_and_uncached_agree(world_model: WorldModel, scene: np.ndarray) -> None:
    texts, horizon = [TEXT, "put the cyan block in the gray bowl"], world_model.longest_horizon or 6
    cached, model = world_model.rollout(scene, texts, horizon=horizon).slots, world_model.model
    with torch.no_grad():
        uncached = model.predictor.rollout(cached[:, :1], model.text(texts), horizon, use_cache=False).slots_BSKD
    torch.testing.assert_close(cached[:, 1:], uncached, atol=1e-4, rtol=1e-3)


def test_attention_is_kept_on_request(world_model: WorldModel, scene: np.ndarray) -> None:
    rollout = world_model.rollout(scene, [TEXT, "put the red block"], horizon=3, attention=True)
    assert rollout.attention is not None
    predictor, K = world_model.model.config.predictor, world_model.model.config.parser.num_slots
    words = len(world_model.words(TEXT))
    assert rollout.attention.shape == (2, 3, predictor.layers, predictor.heads, K, words)
    used = rollout.presence[:, 0] > 0.5 if rollout.layout.explicit else torch.ones(2, K, dtype=torch.bool)
    whole = rollout.attention.sum(-1).movedim(-1, 1)[used]
    torch.testing.assert_close(whole, torch.ones_like(whole))
    assert rollout.attention[1, ..., 4:].max() == 0  # no weight on padding
    part = rollout.select(1)
    assert part.attention is not None and torch.equal(part.attention, rollout.attention[[1]])


def test_videos_are_parsed_one_or_many(world_model: WorldModel, scene: np.ndarray) -> None:
    video = np.stack([np.roll(scene, 2 * t, axis=1) for t in range(3)])
    one, many = world_model.parse(video), world_model.parse(np.stack([video, video[::-1]]))
    assert one.slots.shape[:2] == (1, 3) and many.slots.shape[:2] == (2, 3)


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        (lambda s: s.astype(np.float32), TypeError, r"uint8 .* not float32; .* image\.round\(\)\.astype"),
        (lambda s: s / 255.0, TypeError, r"\(image \* 255\)"),
        (lambda s: s.astype(np.int64), TypeError, "int64"),
        (lambda s: s.astype(np.uint16) * 257, TypeError, r"\(image // 257\)"),
        (lambda s: (s > 50).astype(np.uint8), ValueError, "only the values 0 and 1"),
        (lambda s: s[..., 0], ValueError, r"\(H, W, 3\).*\(32, 32\)"),
        (lambda s: s.transpose(2, 0, 1), ValueError, "three colours last"),
        (lambda s: np.concatenate([s, s[..., :1]], -1), ValueError, "three colours last"),
        (lambda s: s[:, :30], ValueError, "32x30 pixels; .* trained on 32x32, it takes .* such as 64x64"),
        (lambda s: np.zeros((0, 32, 32, 3), np.uint8), ValueError, r"\(0, 32, 32, 3\)"),
        (lambda s: {"image": s}, ValueError, "no 'rgb'; it has 'image'"),
    ],
)
def test_bad_observations_are_refused(placed_world_model, scene, change, error, says) -> None:
    with pytest.raises(error, match=says):
        placed_world_model.rollout(change(scene), TEXT, horizon=2)


def test_bad_videos_are_refused(placed_world_model: WorldModel, scene: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"\(T, H, W, 3\) or \(B, T, H, W, 3\), not \(32, 32, 3\)"):
        placed_world_model.parse(scene)
    with pytest.raises(TypeError, match="video must be uint8"):
        placed_world_model.parse(scene[None].astype(float))


@pytest.mark.parametrize(
    ("text", "says"), [("", "empty text"), ("  ", "empty text"), ([], "no text"), ([TEXT, ""], "empty")]
)
def test_empty_texts_are_refused(placed_world_model, scene, text, says) -> None:
    with pytest.raises(ValueError, match=says):
        placed_world_model.rollout(scene, text)


def test_texts_must_be_text(placed_world_model, scene) -> None:
    with pytest.raises(TypeError, match="not int"):
        placed_world_model.rollout(scene, [TEXT, 3])


@pytest.mark.parametrize(("horizon", "says"), [(0, "at least 1"), (-3, "-3"), (2.5, "2.5"), (9, "at most 8.*go on")])
def test_impossible_horizons_are_refused(placed_world_model, scene, horizon, says) -> None:
    with pytest.raises(ValueError, match=says):
        placed_world_model.rollout(scene, TEXT, horizon=horizon)


def test_a_film_is_as_long_as_the_model_looks_ahead(placed_world_model: WorldModel, scene: np.ndarray) -> None:
    assert placed_world_model.rollout(scene, TEXT).slots.shape[1] == placed_world_model.longest_horizon + 1 == 9


def test_the_longest_horizon_works(placed_world_model: WorldModel, scene: np.ndarray) -> None:
    assert placed_world_model.longest_horizon == 8
    assert placed_world_model.rollout(scene, TEXT, horizon=np.int64(8)).slots.shape[1] == 9


@pytest.mark.parametrize("text", [None, 3, b"put the red block in the blue bowl", {"a": TEXT}])
def test_a_text_of_another_kind_is_refused(placed_world_model, scene, text) -> None:
    with pytest.raises(TypeError, match=f"give one text, or a list of texts, and not {type(text).__name__}"):
        placed_world_model.rollout(scene, text, horizon=1)


def test_a_word_it_has_never_met_is_a_warning_that_names_it(placed_world_model, scene) -> None:
    with pytest.warns(UserWarning, match="'flurb'") as caught:
        placed_world_model.rollout(scene, "put the flurb block in the blue bowl", horizon=1)
    assert Path(caught[0].filename).name == "test_world_model.py"  # points at the caller
    with pytest.warns(UserWarning, match="'flurb'") as caught:
        placed_world_model.reads("put the flurb block in the blue bowl")
    assert Path(caught[0].filename).name == "test_world_model.py"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        placed_world_model.rollout(scene, TEXT, horizon=1)


def test_a_thing_that_nothing_answers_to_is_a_warning_that_names_the_nearest(placed_world_model, scene) -> None:
    text, again = "put the green block in the blue bowl", "put the red block in the blue bowl"
    with pytest.warns(UserWarning, match="nothing seen is 'green'; the nearest is '(blue|red)' and") as caught:
        seen = placed_world_model.rollout(scene, [again, text], horizon=1)
    assert repr(text) in str(caught[0].message) and len(caught) == 1
    assert Path(caught[0].filename).name == "test_world_model.py"  # points at the caller
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        placed_world_model.rollout(seen, text, horizon=1)  # what is imagined may change its looks
        placed_world_model.rollout(scene, text, horizon=1, num_slots=2)  # which do not show everything
    with pytest.warns(UserWarning, match="nothing seen is 'purple'"):
        placed_world_model.rollout(placed_world_model.parse(scene[None]), "put the purple block", horizon=1)


def test_a_thing_in_an_odd_light_is_not_called_absent(placed_world_model, scene) -> None:
    """It is farther from its name's colour than the threshold, and would still be called by no other name."""
    burnt = scene.copy()
    red = (scene[..., 0] > 1.5 * scene[..., 1]) & (scene[..., 0] > 1.5 * scene[..., 2])
    assert red.sum() > 20
    burnt[red] = (255, 64, 64)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", category=ForeignPictureWarning)
        placed_world_model.rollout(burnt, TEXT, horizon=1)


@pytest.mark.parametrize("seed", [None, -1, 2**64, 1.0, True, "0"])
def test_what_is_no_seed_is_refused(placed_world_model, scene, seed) -> None:
    with pytest.raises(ValueError, match=rf"seed must be a whole number from 0 to .*, not {seed!r}"):
        placed_world_model.rollout(scene, TEXT, horizon=1, seed=seed)


def test_a_seed_may_be_numpys(world_model: WorldModel, scene: np.ndarray) -> None:
    same = [world_model.parse(scene[None], seed=seed).slots for seed in (7, np.int64(7), np.uint8(7))]
    assert torch.equal(same[0], same[1]) and torch.equal(same[0], same[2])
    world_model.parse(scene[None], seed=2**64 - 1)


def test_frames_of_a_stack_are_no_scenes(placed_world_model: WorldModel, scene: np.ndarray) -> None:
    frames = np.stack([scene, scene, np.roll(scene, 1, axis=1)])
    obs = {"rgb": frames, "instruction": (TEXT,) * 3}
    with pytest.raises(ValueError, match=r"3 frames of one scene, .*obs\['rgb'\]\[-1\]"):
        placed_world_model.rollout(obs, TEXT, horizon=1)
    for scenes in (
        {**obs, "instruction": (TEXT, TEXT, "put the blue block in the red bowl")},  # of three environments
        {**obs, "rgb": np.stack([scene, np.roll(scene, 12, axis=1), scene[::-1]])},
        {"rgb": frames},
        frames,
    ):
        assert len(placed_world_model.rollout(scenes, TEXT, horizon=1)) == 3


def test_a_folder_is_a_checkpoint(tmp_path: Path, scene: np.ndarray) -> None:
    model = build(PLACED)
    model.save_pretrained(tmp_path)
    loaded = WorldModel.from_pretrained(tmp_path)
    assert torch.equal(
        loaded.rollout(scene, TEXT, horizon=2).slots, WorldModel(model).rollout(scene, TEXT, horizon=2).slots
    )
    assert len(loaded.checkpoint.sha256) == 64
    assert "tiny-placed" not in repr(loaded) and str(tmp_path) in repr(loaded) and "32x32" in repr(loaded)


def test_an_unknown_checkpoint_lists_those_there_are(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"'tabletop-smal'.*Bundled.*config\.json and model\.safetensors"):
        WorldModel.from_pretrained("tabletop-smal")
    with pytest.raises(CheckpointError, match="unknown checkpoint"):
        WorldModel.from_pretrained(tmp_path / "nowhere")
    with pytest.raises(CheckpointError, match=r"no checkpoint.*config\.json"):
        WorldModel.from_pretrained(tmp_path)


def test_a_hub_id_that_cannot_be_fetched_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def offline(*args: object, **kwargs: object) -> str:
        raise OSError("no network")

    monkeypatch.setattr("textocvp.checkpoint.snapshot_download", offline)
    with pytest.raises(CheckpointError, match=r"someone/model.*no network.*Bundled"):
        WorldModel.from_pretrained("someone/model")


def test_a_hub_id_is_fetched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    build(PLACED).save_pretrained(tmp_path)
    monkeypatch.setattr("textocvp.checkpoint.snapshot_download", lambda name, **_: str(tmp_path))
    assert WorldModel.from_pretrained("someone/model").checkpoint.name == "someone/model"


@pytest.mark.skipif("tabletop-small" not in bundled_checkpoints(), reason="the trained checkpoint is not there yet")
def test_the_bundled_checkpoint_loads_and_imagines() -> None:
    world_model = WorldModel.from_pretrained()
    H, W = world_model.image_size
    rollout = world_model.rollout(np.full((H, W, 3), 60, np.uint8), TEXT, horizon=2)
    assert isinstance(rollout, Rollout) and rollout.frames.shape == (1, 3, 3, H, W)


def test_a_scene_is_imagined_alike_wherever_it_stands_in_a_batch() -> None:
    """Slots that are drawn at random included."""
    config = PRESETS["savi-small"]
    model = WorldModel(TextOCVP(replace(config, parser=replace(config.parser, initializer="gaussian"))))
    scenes = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), dtype=np.uint8)
    together = model.rollout(scenes, TEXT, horizon=2, seed=3)
    alone = model.rollout(scenes[2], TEXT, horizon=2, seed=3)
    torch.testing.assert_close(together.slots[2], alone.slots[0], atol=1e-4, rtol=1e-4)
