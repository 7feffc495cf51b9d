"""Configurations: what a setting changes, what JSON becomes, and what is refused by name."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import pytest

from textocvp.baselines.mage import MAGE_PRESETS
from textocvp.config import ModelConfig, build, with_settings
from textocvp.parsers.savi import SaviConfig
from textocvp.presets import PRESETS, preset
from textocvp.renderers.patches import PatchConfig
from textocvp.slots import SlotLayout


@pytest.mark.parametrize("config", [*PRESETS.values(), *MAGE_PRESETS.values()], ids=lambda config: config.name)
def test_json_gives_the_configuration_back(config: Any) -> None:
    assert build(type(config), json.loads(json.dumps(asdict(config)))) == config


def test_settings_reach_the_field_they_name_and_no_other() -> None:
    config = preset("tabletop-small")
    changed = with_settings(
        config,
        [
            "predictor.layers=2",
            "predictor.residual=false",
            "text.kind=transformer",
            "parser.layout.content=32",
            "parser.crop_extent=3",
            'text.vocabulary=["put", "the"]',
        ],
    )
    expected = config.to_dict()
    expected["predictor"] |= {"layers": 2, "residual": False}
    expected["text"] |= {"kind": "transformer", "vocabulary": ("put", "the")}
    expected["parser"]["layout"]["content"] = 32
    expected["parser"]["crop_extent"] = 3.0
    assert changed.to_dict() == expected


def test_a_kind_is_changed_first_and_keeps_what_both_kinds_have() -> None:
    settings = ["parser.iterations_first=3", "parser.layout.explicit=false", "parser.num_slots=9"]
    config = with_settings(preset("tabletop-small"), [*settings, "parser.kind=savi", "renderer.kind=patches"])
    assert config.parser == SaviConfig(num_slots=9, layout=SlotLayout(content=64, explicit=False), iterations_first=3)
    assert config.renderer == PatchConfig(hidden=256)  # as wide as the glimpse renderer's
    with pytest.raises(ValueError, match=r"'savi' needs parser\.layout\.explicit = false"):
        with_settings(preset("tabletop-small"), ["parser.kind=savi"])


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("predictor.layers", "part.field=value"),
        ("predictor.depth=2", "predictor has no field 'depth'; known: kind, dim, layers"),
        ("parser.iterations_first=2", "parser has no field 'iterations_first'; known: kind, .*crop_cells"),
        ("brain.layers=2", "no field 'brain'; known: name, parser"),
        ("predictor.layers=two", "predictor.layers is 'two': must be of type int"),
        ("predictor.layers=2.5", "type int"),
        ("predictor.layers=0", "predictor.layers is 0: must be 1 to 16384"),
        ("predictor.residual=1", "true or false"),
        ("predictor.attention=both", "attention is 'both': must be one of window, causal"),
        ("predictor.feed_forwards=true", "must be one of 1, 2"),
        ("parser.kind=random", "parser.kind is 'random': must be one of placed, savi, holistic"),
        ("renderer.kind=none", "must be one of glimpse, carry, recall, patches, features, broadcast, upsample"),
        ("text.kind=[1]", "must be one of lexicon, transformer, t5, minilm"),
        ("text.vocabulary=put", "text.vocabulary is 'put': must be a list of strings"),
        ("predictor=2", "is a group; set one of kind, dim"),
        ("predictor.layers.first=2", "'predictor.layers' has no fields"),
    ],
)
def test_a_setting_that_makes_no_sense_is_refused_by_name(setting: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        with_settings(preset("tabletop-small"), [setting])


@pytest.mark.parametrize(
    ("part", "value", "message"),
    [
        ("parser", {"image_size": 64}, "parser.kind is None: must be one of placed, savi, holistic"),
        ("parser", 3, "parser.kind is None"),
        ("stage", "third", "stage is 'third': must be one of parser, predictor"),
        ("name", 7, "name is 7: must be of type str"),
    ],
)
def test_a_value_of_json_that_makes_no_sense_is_refused_by_name(part: str, value: object, message: str) -> None:
    data = preset("tabletop-small").to_dict()
    with pytest.raises(ValueError, match=message):
        ModelConfig.from_dict({**data, part: value})
    with pytest.raises(ValueError, match="name is missing"):
        ModelConfig.from_dict({"stage": "parser"})


@pytest.mark.parametrize(("preset_name", "slots"), [("tabletop-small", 1), ("savi-small", 1), ("cliport", 10**9)])
def test_slot_counts_without_sense_are_refused_before_anything_is_built(preset_name: str, slots: int) -> None:
    with pytest.raises(ValueError, match=rf"parser\.num_slots .*{slots}"):
        with_settings(preset(preset_name), [f"parser.num_slots={slots}"])
