"""The named architectures. Sizes of the published models are from TextOCVP (TMLR 2026), section 4 and appendix."""

from __future__ import annotations

from dataclasses import replace

from textocvp.config import ModelConfig
from textocvp.parsers.holistic import HolisticConfig
from textocvp.parsers.placed import PlacedConfig
from textocvp.parsers.savi import SaviConfig
from textocvp.parsers.votes import VotesConfig
from textocvp.predictors.ocvp_seq import OCVPSeqConfig
from textocvp.predictors.textocvp import TextOCVPConfig
from textocvp.renderers.broadcast import BroadcastConfig
from textocvp.renderers.carry import CarryConfig
from textocvp.renderers.glimpse import GlimpseConfig
from textocvp.renderers.patches import FeatureConfig, PatchConfig
from textocvp.renderers.recall import RecallConfig
from textocvp.renderers.upsample import UpsampleConfig
from textocvp.slots import SlotLayout
from textocvp.text.words import WordsConfig

# The words of the tabletop's sentences and its training colours. They keep their rows whatever the captions say, and
# with them a seed keeps its weights.
TABLETOP_WORDS = ("put", "the", "block", "in", "bowl", "and", "then", "into", "a", "on", "place", "move", "of", "with",
                  "to")  # fmt: skip
TABLETOP_COLORS = ("blue", "green", "red", "brown", "cyan", "gray", "yellow")
# Other wordings of its sentences, for models whose captions have none of them.
TABLETOP_REWRITES = (
    "next to | close to => beside",
    "please | kindly | now | just | next one | next | thanks | thank you | carefully | gently | for me | robot => ",
    "hi | hey | hello | okay | would you mind | could you | can you | would you | will you | you should | you can => ",
    "i want you to | i need you to | i would like you to | i'd like you to | i want | i need => ",
    "i would like | i'd like | make sure | let | have => ",
    "go ahead and | go and | use the arm to | use the gripper to | use your arm to | use your gripper to => ",
    "grey => gray",
    "blocks | cube | cubes | brick | bricks | piece | pieces => block",
    "bowls | dish | dishes | container | containers | basin | basins => bowl",
    "all of the | all the | any of the | each of the | one of the => the",
    "a | an | some | this | that | these | those | my | your => the",
    "there is | there's | pick up | pick | grab | grasp | lift up | lift | fetch | get | find | see => take",
    "place | move | set | set down | drop | drop off | lay | lay down | stack | put down | transfer | deposit => put",
    "insert | throw | toss | position | bring | carry | shift | relocate | stick | pop | leave | store | rest => put",
    "putting | placing | placed | moving | moved | setting | dropping | dropped => put",
    "into | inside | inside of | in to | within | down into => in",
    "onto | upon | atop | on top of => on",
    "put it down => put it",
    "up and put it | and then put it | and put it | then put it => put it",
    "take {thing} put it {place} => put {thing} {place}",
    "take {thing} => put {thing}",
    "put {thing} to {place} bowl => put {thing} in {place} bowl",
    "to {place} bowl put {thing} => put {thing} in {place} bowl",
    "should be | should go | should end up | must be | must go | has to be | has to go | needs to be | needs to go => ",
    "shall be | shall go | belongs | goes | go | ends up | end up | be put | is put | to be => ",
)

SMALL_TEXT = WordsConfig(vocabulary=TABLETOP_WORDS, rewrites=TABLETOP_REWRITES)
PUBLISHED_TEXT = WordsConfig(
    kind="transformer",
    dim=512,
    heads=8,
    hidden=1024,
    vocabulary=TABLETOP_WORDS + TABLETOP_COLORS,
    rewrites=TABLETOP_REWRITES,
)
SMALL = TextOCVPConfig(dim=128, layers=3, heads=4, hidden=256, attention="causal", window=24, feed_forwards=1)
SMALL_SEQ = OCVPSeqConfig(dim=128, layers=2, heads=4, hidden=256, attention="causal", window=24)
PUBLISHED = TextOCVPConfig()
PUBLISHED_SEQ = OCVPSeqConfig(dim=128, layers=2, heads=4, hidden=256, age_encoding="sinusoidal")
PUBLISHED_SAVI = SaviConfig(
    num_slots=8,
    layout=SlotLayout(content=128, explicit=False),
    initializer="gaussian",
    iterations_first=3,
    transition_hidden=512,
)

PUBLISHED_DINO = replace(PUBLISHED_SAVI, image_size=336, num_slots=10, encoder="dinov2")

PRESETS = {
    one.name: one
    for one in (  # name, parser, renderer, text, predictor
        ModelConfig("tabletop-small", PlacedConfig(), GlimpseConfig(), SMALL_TEXT, replace(SMALL, color_bias=True)),
        ModelConfig("savi-small", SaviConfig(encoder_stride=2, iterations_first=3),
                    PatchConfig(hidden=64, mask_prior=True), SMALL_TEXT, SMALL),
        ModelConfig("savi-cater", PUBLISHED_SAVI, BroadcastConfig(), PUBLISHED_TEXT, PUBLISHED),
        # CLIPort at 336x336: 24x24 patches.
        ModelConfig("cliport-dino", PUBLISHED_DINO, FeatureConfig(hidden=1024, patches=24), PUBLISHED_TEXT, PUBLISHED),
        # The same with an encoder that is a Python package, at a size that one core trains. Blocks are 10 to 20 pixels
        # wide: cut into 42x42 places their true masks keep an IoU of .83, into 21x21 .50.
        ModelConfig("cliport-lite0",
                    replace(PUBLISHED_DINO, encoder="efficientnet-lite0", encoder_dim=40, encoder_patch=8),
                    FeatureConfig(patches=42, feature_dim=40, image_channels=64), SMALL_TEXT,
                    replace(SMALL, window=56)),
        # CLIPort's scene on CPUs: slots from half its size, and whole episodes, which have up to 57 frames.
        ModelConfig("cliport", VotesConfig(image_size=168, num_slots=12), CarryConfig(), SMALL_TEXT,
                    replace(SMALL, color_bias=True, window=56)),
        # CATER-hard on CPUs: background, a place for a robot that is not there, at most 8 things, and one to spare.
        ModelConfig("cater", VotesConfig(num_slots=11, peak_radius=3.0), RecallConfig(),
                    WordsConfig(kind="transformer"), replace(SMALL, window=29, appearance=True)),
        ModelConfig("ocvp-seq-small", PlacedConfig(), GlimpseConfig(), SMALL_TEXT, SMALL_SEQ),
        ModelConfig("ocvp-seq", PUBLISHED_SAVI, BroadcastConfig(), PUBLISHED_TEXT, PUBLISHED_SEQ),
        ModelConfig("non-oc-small", HolisticConfig(pool_cells=4), UpsampleConfig(), SMALL_TEXT,
                    replace(SMALL, standardize=True)),
        ModelConfig("non-oc", HolisticConfig(layout=SlotLayout(content=512, explicit=False), encoder_channels=64),
                    UpsampleConfig(channels=64), PUBLISHED_TEXT, PUBLISHED),
    )
}  # fmt: skip

# What `textocvp models` says of each preset and bundled checkpoint.
DESCRIPTIONS = {
    "tabletop-small": "TextOCVP as it ships: placed slots, causal predictor, colour lexicon",
    "tabletop-small-40": "tabletop-small, fine-tuned to imagine 40 frames",
    "savi-small": "TextOCVP with published slots, small, for ablations of the parser",
    "savi-cater": "TextOCVP-SAVi at the paper's sizes (CATER)",
    "cliport-dino": "TextOCVP-DINO at the paper's sizes (CLIPort)",
    "cliport-lite0": "TextOCVP-DINO's pipeline on the features of EfficientNet-Lite0, which pip installs",
    "cliport": "TextOCVP for CLIPort's scene: a parser that has learned to see, and sharp frames of 336x336",
    "cater": "TextOCVP for CATER-hard: names are matched with what slots look like",
    "ocvp-seq-small": "OCVP-Seq, no text, on the slots of tabletop-small",
    "ocvp-seq": "OCVP-Seq, no text, at its published size",
    "non-oc-small": "Non-OC, one slot for the whole scene, small",
    "non-oc": "Non-OC at the paper's sizes",
    "mage-small": "MAGE, no slots, small",
    "mage": "MAGE at its published sizes",
    "mage-dino": "MAGE-DINO at the paper's sizes (CLIPort)",
}


def preset(name: str) -> ModelConfig:
    """The preset of that name; else a KeyError lists those that exist."""
    try:
        return PRESETS[name]
    except KeyError:
        raise KeyError(f"unknown preset {name!r}; known: {', '.join(sorted(PRESETS))}") from None
