"""Every choice of architecture, as dataclasses, and the named presets that put them together.

A checkpoint stores one `ModelConfig` as JSON; `ModelConfig.from_dict` reads it back and names any field it does not
know. Sizes of the published model are from TextOCVP (TMLR 2026), section 4 and appendix.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from textocvp.predictors.textocvp import TextOCVPConfig
from textocvp.slots import SlotLayout

C = TypeVar("C")
"""A configuration: any dataclass made of the groups below or of its own."""


@dataclass(frozen=True)
class ParserConfig:
    """From a frame to slots: encoder -> initializer -> corrector -> transition.

    Attributes:
        image_size: side of the square frame in pixels.
        num_slots: K, background included. Can be raised when the model is used.
        layout: what the numbers of a slot mean.
        initializer: `gaussian` samples from one learned Gaussian (published); `cluster` starts from clusters of colour
            and place, or of the frozen encoder's features.
        encoder: `conv` (learned) or `dinov2` (frozen; `slot_attention` only).
        encoder_channels: width of the convolutional encoder.
        encoder_stride: stride of its first convolution.
        encoder_weights: folder or hub id of the frozen encoder; empty for facebook/dinov2-base from the hub.
        encoder_dim, encoder_patch: width of its features and side of its patches in pixels.
        encoder_fingerprint: of its weights, set when a model that has used them is saved; others are then an error.
        iterations_first, iterations_next: corrector iterations on the first and on later frames.
        corrector: `slot_attention` (published), `placed` (invariant slot attention with explicit colour, place
            and size; needs `layout.explicit`) or `holistic` (no slots: one vector a frame, for Non-OC).
        transition_heads, transition_hidden: the transformer block between frames.
        glimpse_size, glimpse_extent: cells of the canonical picture in which the `placed` corrector reads a slot, and
            how many standard deviations it reaches to each side.
        hidden: width of the `placed` corrector's fully connected layers.
        pool_cells: cells along a side of the frame whose features `holistic` averages: 1 as published.
    """

    image_size: int = 64
    num_slots: int = 12
    layout: SlotLayout = SlotLayout(content=64)
    initializer: Literal["gaussian", "cluster"] = "cluster"
    encoder: Literal["conv", "dinov2"] = "conv"
    encoder_channels: int = 32
    encoder_stride: int = 1
    encoder_weights: str = ""
    encoder_dim: int = 768
    encoder_patch: int = 14
    encoder_fingerprint: str = ""
    iterations_first: int = 1
    iterations_next: int = 1
    corrector: Literal["slot_attention", "placed", "holistic"] = "placed"
    transition_heads: int = 4
    transition_hidden: int = 128
    glimpse_size: int = 24
    glimpse_extent: float = 2.6
    hidden: int = 256
    pool_cells: int = 1


@dataclass(frozen=True)
class RendererConfig:
    """From slots to frames and masks.

    Attributes:
        kind: `broadcast` (spatial broadcast decoder, published), `glimpse` (a small canonical picture a slot,
            placed at the slot's position and scale over a background canvas; needs `layout.explicit`), `patches`
            (an MLP draws patch by patch), `features` (the MLP reconstructs the features of a frozen encoder, and a
            convolutional decoder draws those; needs `parser.encoder` `dinov2`) or `upsample` (one slot is the whole
            frame, for Non-OC).
        channels: width of the decoder's convolutions (`broadcast` and `upsample` only).
        hidden: width of the decoder's fully connected layers (`glimpse`, `patches` and `features` only).
        glimpse_size: side of the canonical picture in cells (`glimpse` only).
        glimpse_extent: how many standard deviations the glimpse reaches to each side (`glimpse` only).
        patches: patches along a side of the frame (`patches` and `features` only).
        layers: linear layers of the MLP (`patches` and `features` only).
        mask_prior: add a Gaussian at the place and of the size that a linear layer reads off the slot to the logits
            of its mask (`patches` and `features` only).
        feature_dim: width of the reconstructed features, `parser.encoder_dim` (`features` only).
        image_decoder: from features to pixels: `cnn` (published) or `vqgan` (larger and sharper) (`features` only).
        image_channels: width of the first convolution of `cnn`; that of `vqgan` is half of it (`features` only).
    """

    kind: Literal["broadcast", "glimpse", "patches", "features", "upsample"] = "glimpse"
    channels: int = 32
    hidden: int = 256
    glimpse_size: int = 24
    glimpse_extent: float = 2.6
    patches: int = 16
    layers: int = 4
    mask_prior: bool = False
    feature_dim: int = 768
    image_decoder: Literal["cnn", "vqgan"] = "cnn"
    image_channels: int = 1024


@dataclass(frozen=True)
class TextConfig:
    """From a sentence to tokens.

    Attributes:
        kind: `transformer` (small, from scratch), `lexicon` (the same, and every token also carries the RGB of the
            colour that it names, from a public colour lexicon), `t5` (a pretrained T5 encoder, the paper's default)
            or `minilm` (the pretrained sentence model all-MiniLM-L6-v2).
        dim: width of the token embeddings handed to the predictor.
        layers, heads, hidden: the transformer (`transformer` and `lexicon` only).
        max_tokens: longest sentence in words (`t5`, `minilm`: subwords and end marks); a longer one is an error.
        weights: folder or hub id of the pretrained weights; empty for google-t5/t5-small from the hub, or for the
            Python package of MiniLM (`t5` and `minilm` only).
        frozen: keep the pretrained weights as they are and out of checkpoints; else they are fine-tuned and stored
            (`t5` and `minilm` only).
        fingerprint: of the frozen weights, set when they are first used; other weights are then an error.
    """

    kind: Literal["transformer", "lexicon", "t5", "minilm"] = "lexicon"
    dim: int = 128
    layers: int = 2
    heads: int = 4
    hidden: int = 256
    max_tokens: int = 64
    weights: str = ""
    frozen: bool = True
    fingerprint: str = ""


@dataclass(frozen=True)
class PredictorConfig(TextOCVPConfig):
    """The options of every kind of predictor."""

    kind: Literal["textocvp", "ocvp-seq"] = "textocvp"  # type: ignore[assignment]


@dataclass(frozen=True)
class ModelConfig:
    """A whole TextOCVP.

    Attributes:
        name: the preset it came from.
        parser, renderer, text, predictor: its four parts.
        stage: the last stage of training that a checkpoint has been through. After `parser`, text encoder and predictor
            are still as they were drawn.
    """

    name: str
    parser: ParserConfig = field(default_factory=ParserConfig)
    renderer: RendererConfig = field(default_factory=RendererConfig)
    text: TextConfig = field(default_factory=TextConfig)
    predictor: PredictorConfig = field(default_factory=PredictorConfig)
    stage: Literal["parser", "predictor"] = "predictor"

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dictionaries, ready for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> ModelConfig:
        """The inverse of `to_dict`.

        Raises:
            ValueError: if a field is unknown; the message gives its full name and the fields that exist.
        """
        return build(cls, data, "config")


def _groups(cls: type) -> dict[str, Any]:
    """The fields of a configuration that are configurations themselves, and their classes."""
    hints = get_type_hints(cls)
    return {f.name: hints[f.name] for f in fields(cls) if is_dataclass(hints[f.name])}


def build(cls: Any, data: Mapping[str, Any], path: str) -> Any:
    """A configuration from plain nested dictionaries.

    Args:
        cls: its dataclass.
        path: what to call it in messages.

    Raises:
        ValueError: if a field is unknown or missing; the message gives its full name and the fields that exist.
    """
    names = [f.name for f in fields(cls)]
    unknown = sorted(set(data) - set(names))
    if unknown:
        raise ValueError(f"{path}: unknown field {unknown[0]!r}; known: {', '.join(names)}")
    groups = _groups(cls)
    values = {
        key: build(groups[key], value, f"{path}.{key}")
        if key in groups and isinstance(value, Mapping)
        else value
        for key, value in data.items()
    }
    try:
        return cls(**values)
    except TypeError as error:
        raise ValueError(f"{path}: {error}") from error


def with_settings(config: C, settings: Iterable[str]) -> C:
    """The configuration with some fields changed, each written `part.field=value`.

    For example `predictor.layers=2`, `predictor.residual=false`, `parser.layout.content=32`.

    Raises:
        ValueError: if a setting is not of that form, the field does not exist, or the value is not allowed; the message
            says what is.
    """
    for setting in settings:
        path, equals, text = setting.partition("=")
        if not equals:
            raise ValueError(f"{setting!r}: write part.field=value, for example predictor.layers=2")
        config = _changed(config, path.split("."), text, path)
    return config


def _changed(node: Any, names: list[str], text: str, path: str) -> Any:
    known = [f.name for f in fields(node)]
    if names[0] not in known:
        raise ValueError(f"unknown setting {path!r}: no field {names[0]!r}; known: {', '.join(known)}")
    value = getattr(node, names[0])
    if len(names) > 1:
        if not is_dataclass(value):
            raise ValueError(f"unknown setting {path!r}: {names[0]!r} has no fields")
        return replace(node, **{names[0]: _changed(value, names[1:], text, path)})
    if is_dataclass(value):
        raise ValueError(f"{path!r} is a group; set one of {', '.join(f.name for f in fields(value))}")
    try:
        chosen = json.loads(text)
    except json.JSONDecodeError:
        chosen = text
    kind = get_type_hints(type(node))[names[0]]
    if get_origin(kind) is Literal:
        if chosen not in get_args(kind):
            raise ValueError(f"{path}={text}: must be one of {', '.join(map(str, get_args(kind)))}")
    elif kind is float and type(chosen) is int:
        chosen = float(chosen)
    elif type(chosen) is not kind:
        raise ValueError(f"{path}={text}: must be a value of type {kind.__name__}")
    return replace(node, **{names[0]: chosen})
