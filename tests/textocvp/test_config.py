"""Changing single settings of a preset."""

from __future__ import annotations

import pytest

from textocvp.config import with_settings
from textocvp.presets import preset


def test_settings_reach_the_field_they_name_and_no_other() -> None:
    config = preset("tabletop-small")
    changed = with_settings(
        config,
        [
            "predictor.layers=2",
            "predictor.residual=false",
            "text.kind=transformer",
            "parser.layout.content=32",
        ],
    )
    expected = config.to_dict()
    expected["predictor"] |= {"layers": 2, "residual": False}
    expected["text"]["kind"] = "transformer"
    expected["parser"]["layout"]["content"] = 32
    assert changed.to_dict() == expected


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("predictor.layers", "part.field=value"),
        ("predictor.depth=2", "no field 'depth'; known: kind, dim, layers"),
        ("brain.layers=2", "no field 'brain'"),
        ("predictor.layers=two", "type int"),
        ("predictor.layers=2.5", "type int"),
        ("predictor.residual=1", "type bool"),
        ("parser.initializer=random", "one of gaussian, cluster"),
        ("predictor=2", "is a group"),
        ("predictor.layers.first=2", "has no fields"),
    ],
)
def test_a_setting_that_makes_no_sense_is_refused_by_name(setting: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        with_settings(preset("tabletop-small"), [setting])
