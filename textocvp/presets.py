"""Every choice of architecture, as dataclasses, and the named presets that put them together.

A checkpoint stores one `ModelConfig` as JSON; `ModelConfig.from_dict` reads it back and names any field it does not
know. Sizes of the published model are from TextOCVP (TMLR 2026), section 4 and appendix.
"""

from __future__ import annotations

from dataclasses import replace

from textocvp.config import ModelConfig, ParserConfig, PredictorConfig, RendererConfig, TextConfig
from textocvp.slots import SlotLayout

PRESETS: dict[str, ModelConfig] = {
    # The one that ships: small enough to train on two CPU cores in hours.
    "tabletop-small": ModelConfig(
        name="tabletop-small",
        predictor=PredictorConfig(
            dim=128,
            layers=3,
            heads=4,
            hidden=256,
            attention="causal",
            window=24,
            color_bias=True,
            feed_forwards=1,
        ),
    ),
    # Published slots without explicit places, at sizes that two CPU cores train in minutes: for the ablations of the
    # first slots (`parser.initializer`) and of the renderer's `mask_prior`.
    "savi-small": ModelConfig(
        name="savi-small",
        parser=ParserConfig(
            layout=SlotLayout(content=64, explicit=False),
            encoder_stride=2,
            iterations_first=3,
            corrector="slot_attention",
        ),
        renderer=RendererConfig(kind="patches", hidden=64, mask_prior=True),
        predictor=PredictorConfig(
            dim=128,
            layers=3,
            heads=4,
            hidden=256,
            attention="causal",
            window=24,
            feed_forwards=1,
        ),
    ),
    # The paper's TextOCVP-SAVi at its own sizes (CATER, 64x64).
    "savi-cater": ModelConfig(
        name="savi-cater",
        parser=ParserConfig(
            num_slots=8,
            layout=SlotLayout(content=128, explicit=False),
            initializer="gaussian",
            iterations_first=3,
            corrector="slot_attention",
            transition_hidden=512,
        ),
        renderer=RendererConfig(kind="broadcast"),
        text=TextConfig(kind="transformer", dim=512, heads=8, hidden=1024),
    ),
}

# The paper's TextOCVP-DINO at its own sizes (CLIPort, 336x336: 24x24 patches).
PRESETS["cliport-dino"] = ModelConfig(
    name="cliport-dino",
    parser=ParserConfig(
        image_size=336,
        num_slots=10,
        layout=SlotLayout(content=128, explicit=False),
        initializer="gaussian",
        encoder="dinov2",
        iterations_first=3,
        corrector="slot_attention",
        transition_hidden=512,
    ),
    renderer=RendererConfig(kind="features", hidden=1024, patches=24),
    text=TextConfig(kind="transformer", dim=512, heads=8, hidden=1024),
)

# OCVP-Seq, the predictor without text: beside the shipped model, and at its published size beside TextOCVP-SAVi.
PRESETS["ocvp-seq-small"] = replace(
    PRESETS["tabletop-small"],
    name="ocvp-seq-small",
    predictor=PredictorConfig(
        kind="ocvp-seq", dim=128, layers=2, heads=4, hidden=256, attention="causal", window=24
    ),
)
PRESETS["ocvp-seq"] = replace(
    PRESETS["savi-cater"],
    name="ocvp-seq",
    predictor=PredictorConfig(
        kind="ocvp-seq", dim=128, layers=2, heads=4, hidden=256, age_encoding="sinusoidal"
    ),
)

# Non-OC, the same predictor over one slot a frame: beside the shipped model, and at its published size.
PRESETS["non-oc-small"] = ModelConfig(
    name="non-oc-small",
    parser=ParserConfig(
        num_slots=1, layout=SlotLayout(content=256, explicit=False), corrector="holistic", pool_cells=4
    ),
    renderer=RendererConfig(kind="upsample"),
    predictor=PredictorConfig(
        dim=128,
        layers=3,
        heads=4,
        hidden=256,
        attention="causal",
        window=24,
        feed_forwards=1,
        standardize=True,
    ),
)
PRESETS["non-oc"] = replace(
    PRESETS["savi-cater"],
    name="non-oc",
    parser=ParserConfig(
        num_slots=1, layout=SlotLayout(content=512, explicit=False), corrector="holistic", encoder_channels=64
    ),
    renderer=RendererConfig(kind="upsample", channels=64),
)


def preset(name: str) -> ModelConfig:
    """The preset of that name.

    Raises:
        KeyError: if there is none; the message lists those that exist.
    """
    try:
        return PRESETS[name]
    except KeyError:
        raise KeyError(f"unknown preset {name!r}; known: {', '.join(sorted(PRESETS))}") from None
