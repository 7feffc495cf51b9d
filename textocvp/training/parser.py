"""Stage 1: train the parser and the renderer to redraw short clips.

    textocvp train parser --data data/tabletop-train.h5 --val data/tabletop-val.h5 --out runs/parser

No label is used: the loss compares the drawn frame with the frame, the drawn masks with the parser's own attention,
and the places that the transition expected with those that the corrector found. A parser that is taught (`votes`)
learns from masks that the videos give of themselves, or from those of the simulator (`--teacher masks`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from textocvp.config import with_settings
from textocvp.data.episodes import Episodes
from textocvp.model import TextOCVP
from textocvp.parsers.votes import VotesParser
from textocvp.pictures import color_masks
from textocvp.presets import preset
from textocvp.slots import SlotState
from textocvp.training.clips import ClipTraining, check_clips, clip_reader, save_samples, to_pictures
from textocvp.training.evaluate_parser import ParserMetrics, measure_own_frames, measure_parser
from textocvp.training.losses import ParserLoss, image_loss, mask_loss, place_loss, read_place_loss, thing_weights
from textocvp.training.run import Run, SettingsError, allowed_settings, close_run, open_data, open_run
from textocvp.training.teacher import Teacher

Learner = Literal["all", "sight", "renderer"]  # what of a checkpoint goes on learning


@dataclass(kw_only=True)
class ParserTraining(ClipTraining):
    """Train the scene parser and the renderer (stage 1)."""

    preset: str = "tabletop-small"
    """Architecture; `textocvp models` lists the presets."""
    episodes: int | None = 2000
    steps: int = 2000
    learning_rate: float = 4e-4
    warmup: int = 300
    teacher: Literal["video", "masks"] = "video"
    """Who says what pixels show (parser `votes` only): the videos themselves, or the masks of the episodes."""
    first_redraw: int = 0
    """Update at which the renderer begins to learn; before it, only a parser that is taught does."""
    taught: Path | None = None
    """Checkpoint with a parser that has been taught, which sees as it did there: only what its slots hold, and the
    renderer, are trained."""

    start: Path | None = None
    """Checkpoint to begin with, whose architecture is kept, instead of random weights: first stills, then clips."""
    only: Learner = "all"
    """What of `start` goes on learning: `sight`, the network of a parser that is taught, or the `renderer`; all else
    stays as it is, a predictor, too. With `all` parser and renderer begin with its weights, and there is no
    predictor."""


class ParserStage(nn.Module):
    """What stage 1 trains, as one module, so that several processes can share its gradients."""

    def __init__(self, model: TextOCVP) -> None:
        super().__init__()
        self.parser, self.renderer = model.parser, model.renderer

    def forward(
        self,
        frames_BT3HW: Tensor,
        weights_N1HW: Tensor,
        *,
        whole: Tensor | None = None,
        weight: float = 1.0,
        generator: Sequence[torch.Generator] | None = None,
        features_BTLF: Tensor | None = None,
        lesson: tuple[Tensor, Tensor] | None = None,
        redraw: bool = True,
    ) -> ParserLoss:
        """The terms of stage 1 for clips in -1..1, or what a micro-batch adds to those of the batch.

        Args:
            weights_N1HW: how much each pixel of the N = B * T frames counts, see `thing_weights`.
            whole: the sum of those weights over the whole batch; None for clips that are a whole batch.
            weight: how much of the batch these clips are.
            generator: one for each clip, for parsers that draw their first slots.
            features_BTLF: of the parser's frozen encoder, where they are cached.
            lesson: frames like `frames_BT3HW` and what their pixels show, for a parser that is taught.
            redraw: whether there is anything to learn beside the lesson.
        """
        zero = frames_BT3HW.new_zeros(())
        taught = zero if lesson is None else weight * self.parser.lesson_loss(*(x.flatten(0, 1) for x in lesson))
        if not redraw:
            return ParserLoss(zero, zero, zero, zero, taught)
        known = {} if features_BTLF is None else {"features_BTLF": features_BTLF}
        parsed = self.parser(frames_BT3HW, generator=generator, **known)
        target = frames_BT3HW.flatten(0, 1)
        slots_NKD, attention_NKHW = parsed.slots_BTKD.flatten(0, 1), parsed.attention_BTKHW.flatten(0, 1)
        rendered = self.renderer(slots_NKD)
        mask = place = feature = zero
        places = self.renderer.places(slots_NKD)
        if places is not None:
            place = read_place_loss(*places, attention_NKHW)
        if parsed.expected_BTKD is not None:
            layout = self.parser.layout
            mask = mask_loss(rendered, attention_NKHW, weights_N1HW, whole)
            found = SlotState.split(parsed.slots_BTKD[:, 1:], layout)
            place = place_loss(SlotState.split(parsed.expected_BTKD, layout), found)
        if rendered.features_BLF is not None and parsed.features_BTLF is not None:
            feature = F.mse_loss(rendered.features_BLF, parsed.features_BTLF.flatten(0, 1))
        image = image_loss(rendered, target, weights_N1HW, whole)
        return ParserLoss(image, mask, weight * place, weight * feature, taught)


def train(args: ParserTraining) -> ParserMetrics | None:
    """Run or continue stage 1; writes `out`/checkpoint.

    Returns:
        figures of all held-out episodes; None on all processes but the main one.

    Raises:
        SettingsError: if the settings exclude each other, or this machine cannot do what they ask for.
        WeightsError: if the weights of the parser's frozen encoder are missing.
        CacheError: if `out` holds features of another encoder or of other episodes.
    """
    # On single frames the transition takes no part, and before the first redraw nothing but the lesson.
    some_unused = args.clip == 1 or args.first_redraw > 0 or args.only == "sight"
    accelerator = open_run(args.out, args.precision, some_unused=some_unused)
    torch.manual_seed(args.seed)
    with allowed_settings():
        config = replace(with_settings(preset(args.preset), args.set), stage="parser")
        model = TextOCVP(config)
    learns = model.parser.taught and args.taught is None and args.only != "renderer"
    check_lesson(args, learns)
    if args.start is not None:
        model = go_on_from(model, args.start, args.only)
    if args.taught is not None:
        keep_taught(model, args.taught)
    model.to(accelerator.device)
    with open_data(args, model.config.parser.image_size, "parser.image_size") as (episodes, held_out):
        check_clips(args, episodes, model.parser.frozen)
        if learns and args.teacher == "masks" and ((truth := episodes.truth(0)) is None or truth.segmentation is None):
            raise SettingsError(f"{args.data} has no masks to teach with: leave out --teacher masks")
        run = Run(args, accelerator, ParserStage(model))

        def measure(count: int | None) -> ParserMetrics:
            return measure_parser(model, held_out, range(len(held_out))[:count])

        teacher = Teacher(args.teacher, episodes) if learns else None
        reader = clip_reader(run, args, episodes, model.parser.frozen, teacher)
        for step, clips in reader.steps(run, "parser"):
            frames_BT3HW, features_BTLF = clips.on(run.device)
            lesson = clips.lesson(run.device)
            weights_BT1HW = thing_weights(frames_BT3HW, args.thing_weight)
            whole = run.total(weights_BT1HW.sum())
            for part in run.micro_batches():
                generators = [torch.Generator().manual_seed(int(seed)) for seed in clips.seeds_B[part]]
                loss: ParserLoss = run.module(
                    frames_BT3HW[part],
                    weights_BT1HW[part].flatten(0, 1),
                    whole=whole,
                    weight=run.weight(part),
                    generator=generators,
                    features_BTLF=None if features_BTLF is None else features_BTLF[part],
                    lesson=None if lesson is None else (lesson[0][part], lesson[1][part]),
                    redraw=step >= args.first_redraw and args.only != "sight",
                )
                run.backward(loss.total(), vars(loss))
            run.update(step)
            run.evaluate(step, measure, lambda path: draw_samples(model, held_out, path))

        def save(folder: Path) -> None:
            model.config = replace(model.config, own_frames=measure_own_frames(model, held_out))
            model.save_pretrained(folder)

        metrics = run.finish(save, measure, "quality.json")
        for sentence in metrics.below_threshold() if metrics is not None else ():
            print(f"not good enough to train a predictor on: {sentence}")
    close_run(accelerator)
    return metrics


def check_lesson(args: ParserTraining, learns: bool) -> None:
    """Raise a SettingsError where what a parser is to be taught does not go together."""
    if args.first_redraw and not learns:
        raise SettingsError("first_redraw is for parsers that are taught: set parser.kind=votes and leave out taught")
    if args.only == "sight" and (args.start is None or not learns):
        raise SettingsError("only sight is for parsers that are taught: name a checkpoint of one with --start")
    if args.only == "renderer" and (args.start is None or args.taught is not None):
        raise SettingsError("only renderer goes on from a whole checkpoint: name it with --start, and leave out taught")


def go_on_from(model: TextOCVP, checkpoint: Path, only: Learner) -> TextOCVP:
    """The model with parser and renderer of a checkpoint, or that checkpoint as a whole, of which only a part learns.

    Raises:
        SettingsError: if the checkpoint was built otherwise.
    """
    source = TextOCVP.from_pretrained(str(checkpoint)).train()
    parser, encoder = model.config.parser, model.parser.frozen
    if encoder is not None and source.parser.frozen is not None and not encoder.fingerprint:
        encoder.fingerprint = source.parser.frozen.fingerprint  # the same weights, or an error when they are read
        parser = replace(parser, encoder_fingerprint=encoder.fingerprint)  # type: ignore[call-arg]
    if (source.config.parser, source.config.renderer) != (parser, model.config.renderer):
        raise SettingsError(f"{checkpoint} is built otherwise: give the same preset and set as it was trained with")
    if only == "renderer":
        source.requires_grad_(False)
        source.renderer.requires_grad_(True)
    if only != "all":
        return source
    model.parser.load_state_dict(source.parser.state_dict())
    model.renderer.load_state_dict(source.renderer.state_dict())
    return model


def keep_taught(model: TextOCVP, checkpoint: Path) -> None:
    """Give the parser the network of a checkpoint's, and no gradient to it.

    Raises:
        SettingsError: if the parser is none that is taught, or its network has other sizes.
    """
    source = TextOCVP.from_pretrained(str(checkpoint)).parser
    if not isinstance(model.parser, VotesParser) or not isinstance(source, VotesParser):
        raise SettingsError("taught is for parsers that are, in preset and checkpoint: parser.kind=votes")
    try:
        model.parser.network.load_state_dict(source.network.state_dict())
    except RuntimeError as error:
        raise SettingsError(f"the parser of {checkpoint} has another network: {error}") from error
    model.parser.network.requires_grad_(False)


@torch.no_grad()
def draw_samples(model: TextOCVP, episodes: Episodes, path: Path) -> None:
    """A picture with three rows an episode: frames, frames redrawn from their slots, and the slots' masks."""

    def redraw(index: int, frames_T3HW: Tensor, times: NDArray[np.int64]) -> Iterator[NDArray[np.uint8]]:
        seeded = torch.Generator(model.device).manual_seed(index)
        slots_NKD = model.parser(frames_T3HW[None], generator=seeded).slots_BTKD[0, times]
        rendered = model.renderer(slots_NKD)
        yield to_pictures(rendered.frames_B3HW)
        if slots_NKD.shape[1] > 1:  # one slot has no mask worth a row
            yield color_masks(rendered.masks_BKHW.cpu().numpy())

    save_samples(path, episodes, redraw, model.device)
