"""The configuration of a whole model: one dataclass a part, chosen by its `kind`, and how text becomes one.

The options of a part stand beside its class (`textocvp.parsers`, `renderers`, `text`, `predictors`). A checkpoint
stores one `ModelConfig` as JSON; `--set part.field=value` changes one on the command line.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields, is_dataclass
from importlib import import_module
from typing import Any, ClassVar, Literal, TypeVar, get_args, get_origin, get_type_hints

from textocvp.inputs import OwnFrames
from textocvp.parsers import PARSERS, ParserConfig
from textocvp.parsers.placed import PlacedConfig
from textocvp.pictures.restorer import RestorerConfig
from textocvp.predictors import PREDICTORS, PredictorConfig
from textocvp.predictors.textocvp import TextOCVPConfig
from textocvp.renderers import RENDERERS, RendererConfig
from textocvp.renderers.glimpse import GlimpseConfig
from textocvp.text import ENCODERS, TextConfig
from textocvp.text.words import WordsConfig

C = TypeVar("C")

MOST = 1 << 14  # of any size: more is a slip, and would fill the memory before it is noticed


@dataclass(frozen=True)
class ModelConfig:
    """A whole TextOCVP."""

    # Of each part, the classes that its `kind` names; their `Config` says which options there are.
    KINDS: ClassVar[Mapping[str, Mapping[str, type]]] = {
        "parser": PARSERS,
        "renderer": RENDERERS,
        "text": ENCODERS,
        "predictor": PREDICTORS,
        "outcome": PREDICTORS,
    }

    name: str  # the preset it came from
    parser: ParserConfig = field(default_factory=PlacedConfig)
    renderer: RendererConfig = field(default_factory=GlimpseConfig)
    text: TextConfig = field(default_factory=WordsConfig)
    predictor: PredictorConfig = field(default_factory=TextOCVPConfig)
    # A second predictor, whose one step is a whole sentence: it says where everything ends. None where it has not been
    # trained.
    outcome: PredictorConfig | None = None
    # The last stage of training that it has been through. After `parser`, text encoder and predictor are as drawn.
    stage: Literal["parser", "predictor"] = "predictor"
    # What pictures of its world are like, for a warning about others; None where nobody measured it.
    own_frames: OwnFrames | None = None
    # A network that takes noise and JPEG off pictures of its world; None where it has not been trained.
    restorer: RestorerConfig | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dictionaries, ready for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> ModelConfig:
        """The inverse of `to_dict`; errors as `build`."""
        return build(cls, data)


def build(cls: type[C], data: Any, path: str = "") -> C:
    """A configuration from plain nested dictionaries.

    Args:
        cls: its dataclass. A field in its `KINDS` is of the class that its own field `kind` names.
        path: where it lies in the whole configuration, for messages.

    Raises:
        ValueError: if a field is unknown or missing, or a value is not allowed; the message names the field and says
            what is allowed.
    """
    if not isinstance(data, Mapping):
        raise ValueError(f"{path or 'the configuration'} must be a group of fields, not {data!r}")
    known = {f.name: f for f in fields(cls)}  # type: ignore[arg-type]
    hints, kinds = get_type_hints(cls), getattr(cls, "KINDS", {})
    for name in data:
        if name not in known:
            raise ValueError(f"{path or 'the configuration'} has no field {name!r}; known: {', '.join(known)}")
    values: dict[str, Any] = {}
    for name, one in known.items():
        where = f"{path}.{name}" if path else name
        if name not in data:
            if one.default is MISSING and one.default_factory is MISSING:
                raise ValueError(f"{where} is missing")
        elif data[name] is None and type(None) in get_args(hints[name]):
            values[name] = None
        elif name in kinds:
            values[name] = build(config_class(kinds[name], data[name], where), data[name], where)
        elif nested := [hint for hint in (hints[name], *get_args(hints[name])) if is_dataclass(hint)]:
            values[name] = build(nested[0], data[name], where)  # type: ignore[arg-type]
        else:
            values[name] = _checked(data[name], hints[name], where)
    return cls(**values)


def config_class(kinds: Mapping[str, type], data: Any, path: str) -> Any:
    """The dataclass of the part whose settings are `data`; errors as `build`."""
    kind = data.get("kind") if isinstance(data, Mapping) else None
    if not isinstance(kind, str) or kind not in kinds:
        raise ValueError(f"{path}.kind is {kind!r}: must be one of {', '.join(kinds)}")
    return getattr(kinds[kind], "Config", kinds[kind])


def with_settings(config: C, settings: Iterable[str]) -> C:
    """The configuration with some fields changed, each written `part.field=value`.

    For example `predictor.layers=2`, `predictor.residual=false`, `parser.layout.content=32`. Where `part.kind` changes,
    the fields that both kinds have keep their values, and other settings are of the new kind, in whichever order.

    Raises:
        ValueError: if a setting is not of that form, the field does not exist, or the value is not allowed; the message
            says what is.
    """
    data, kinds = asdict(config), getattr(config, "KINDS", {})  # type: ignore[call-overload]
    changes = []
    for setting in settings:
        path, equals, text = setting.partition("=")
        if not equals:
            raise ValueError(f"{setting!r}: write part.field=value, for example predictor.layers=2")
        try:
            changes.append((path.split("."), json.loads(text)))
        except json.JSONDecodeError:
            changes.append((path.split("."), text))
    for names, value in sorted(changes, key=lambda change: change[0][-1] != "kind"):
        *groups, last = names
        node = data
        for depth, name in enumerate(groups):
            if name not in node:  # `build` says what there is
                node[name] = {}
            node = node[name]
            if not isinstance(node, dict):
                raise ValueError(f"{'.'.join(names)}: {'.'.join(groups[: depth + 1])!r} has no fields")
        if isinstance(node.get(last), dict):
            raise ValueError(f"{'.'.join(names)!r} is a group; set one of {', '.join(node[last])}")
        node[last] = value
        if last == "kind" and groups and groups[0] in kinds:
            allowed = {f.name for f in fields(config_class(kinds[groups[0]], node, groups[0]))}
            data[groups[0]] = {name: old for name, old in node.items() if name in allowed}
    return build(type(config), data)


def _checked(value: Any, hint: Any, path: str) -> Any:
    """The value if a field of that type may have it."""
    if get_origin(hint) is Literal:
        allowed = get_args(hint)
        if not any(value == one and type(value) is type(one) for one in allowed):
            raise ValueError(f"{path} is {value!r}: must be one of {', '.join(map(str, allowed))}")
        return value
    if get_origin(hint) is tuple:
        if not isinstance(value, list | tuple) or not all(isinstance(one, str) for one in value):
            raise ValueError(f"{path} is {value!r}: must be a list of strings")
        return tuple(value)
    if hint is float and type(value) is int:
        return float(value)
    if type(value) is not hint:
        kind = "true or false" if hint is bool else f"of type {hint.__name__}"
        raise ValueError(f"{path} is {value!r}: must be {kind}")
    if hint is int and not 1 <= value <= MOST:
        raise ValueError(f"{path} is {value}: must be 1 to {MOST}")
    if hint is float and math.isnan(value):
        raise ValueError(f"{path} is not a number")
    return value


def __getattr__(name: str) -> Any:
    if name == "preset":  # where it was before presets had a file of their own: programs of users say it
        return getattr(import_module("textocvp.presets"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
