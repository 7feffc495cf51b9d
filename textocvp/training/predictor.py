"""Stage 2: train the text encoder and the predictor in slot space, with parser and renderer frozen.

    textocvp train predictor --parser runs/parser/checkpoint --data data/tabletop-train.h5 \\
        --val data/tabletop-val.h5 --out runs/predictor

Every episode is parsed once. Then the `causal` form learns from whole episodes, all frames in one pass: first
teacher forced; then the model imagines a growing part of the episode, up to all of it, and from its own
imagined frames must predict the true next ones (dataset aggregation, Ross et al. 2011: what rollouts need,
for little more than the price of teacher forcing). The published `window` form sees both ways and so cannot
be teacher forced in one pass: it learns from rollouts, with the gradient flowing back through them, as
published. """

from __future__ import annotations

import copy
import dataclasses
import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from accelerate import Accelerator
from torch import Tensor, nn
from tqdm import tqdm

from textocvp.config import ModelConfig, with_settings
from textocvp.data.episodes import EpisodeFile
from textocvp.data.slot_batches import SlotBatch, SlotBatches, true_frames
from textocvp.data.slot_cache import SlotCache, cached_slots, parse_share
from textocvp.layers import sinusoids
from textocvp.model import TextOCVP
from textocvp.predictors import PredictorConfig
from textocvp.predictors.base import SlotPredictor
from textocvp.presets import preset
from textocvp.text.base import TextEncoder, WordBatch
from textocvp.training.evaluate_predictor import FollowingTest, InstructionFollowing, following_questions
from textocvp.training.losses import moving_weights, slot_loss
from textocvp.training.run import (
    Run,
    SettingsError,
    TrainingSettings,
    allowed_settings,
    check_frame_size,
    finish,
    start,
    step_rng,
)


@dataclass(kw_only=True)
class PredictorTraining(TrainingSettings):
    """Train the text encoder and the predictor on the slots of a trained parser (stage 2)."""

    parser: Path
    """Checkpoint folder with the trained parser and renderer, from `textocvp train parser`."""
    finetune: bool = False
    """Start from the text encoder and the predictor of the checkpoint `parser`, not from new ones. With
    `--set predictor.window=40` they learn longer rollouts."""
    preset: str | None = None
    """Take text encoder and predictor from this preset instead of from the parser's checkpoint."""
    steps: int = 1100
    batch: int = 32
    """Episodes an update, shared out among the processes."""
    learning_rate: float = 1e-3
    evaluate_every: int = 250
    evaluate_episodes: int = 200
    autoregressive: float = 0.4
    """Share of the updates, the last ones, that learn from imagined frames (`window`: all do)."""
    horizon: int = 4
    """Frames of the first rollouts; grows linearly to the whole episode at four fifths of these updates."""
    moving: float = 20.0
    """How much more a slot counts that moves."""
    scale_weight: float = 0.1
    """Weight of the error in size."""
    content_weight: float = 0.3
    """Weight of the error in content."""
    recolor: bool = True
    """Permute the colour channels of scene and lexicon together (text kind `lexicon`; no other words follow)."""
    color_spread: float = 0.0
    """Stretch and shift each colour channel of scene and lexicon alike, by up to this (text kind `lexicon`, without
    image loss)."""
    color_jitter: float = 0.03
    """Standard deviation of the shift of each slot's and each word's colour, in -1..1."""
    forgetful: float = 0.0
    """Share of the episodes whose frames do not see their past (`causal` form), so that only the text tells where
    the arm is heading."""
    place_jitter: float = 0.01
    """Standard deviation of the noise on the teacher's slot places, in -1..1."""
    image_weight: float = 0.0
    """Weight of the error of drawn frames of rollouts; its gradient flows through the frozen renderer."""
    image_frames: int = 2
    """How many frames of each rollout are drawn for it."""


class PredictorStage(nn.Module):
    """What stage 2 trains, as one module, so that several processes can share its gradients."""

    def __init__(self, model: TextOCVP) -> None:
        super().__init__()
        self.text: TextEncoder = model.text
        self.predictor: SlotPredictor = model.predictor
        if not self.predictor.uses_text:  # several processes would wait for gradients that never come
            self.text.requires_grad_(False)

    def forward(self, seen_BTKD: Tensor, words: WordBatch, imagined: int) -> Tensor:
        """Predictions (B, S, K, D), the last of which is of the frame number T + imagined (the first is
        number 0).

        The `causal` form predicts from every true and every imagined frame the next, S = T + imagined. The
        `window` form only predicts new frames, S = imagined + 1."""
        text = self.text.encode(words)
        if not self.predictor.config.causal:
            return self.predictor.rollout(seen_BTKD, text, imagined + 1).slots_BSKD
        if imagined:
            with torch.no_grad():
                imagined_BSKD = self.predictor.rollout(seen_BTKD, text, imagined).slots_BSKD
            # Under autocast some versions of torch would reuse weights that were cast without a gradient.
            torch.clear_autocast_cache()
            seen_BTKD = torch.cat([seen_BTKD, imagined_BSKD], dim=1)
        return self.predictor(seen_BTKD, text)


def train(args: PredictorTraining) -> InstructionFollowing | None:
    """Run or continue stage 2; writes `out`/checkpoint, a whole model, and returns its figures on all of
    `val`.

    The figures are None for slots without explicit places, and on all processes but the main one.

    Raises:
        CheckpointError: if `parser` is no checkpoint.
        SlotCacheError: if `out` holds slots of another parser or of other episodes.
        SettingsError: if the settings exclude each other, or this machine cannot do what they ask for.
    """
    accelerator = start(args.out, args.precision)
    torch.manual_seed(args.seed)
    with EpisodeFile(args.data, first=args.episodes) as episodes, EpisodeFile(args.val) as held_out:
        model = assemble(args, episodes.instructions).to(accelerator.device)
        check_frame_size(model.config.parser.image_size, "parser.image_size", episodes, held_out)
        for file, name in ((episodes, "train"), (held_out, "val")):
            share = (accelerator.process_index, accelerator.num_processes)
            parse_share(model, file, args.out / f"slots-{name}.h5", *share)
        accelerator.wait_for_everyone()
        with accelerator.main_process_first():
            cache = cached_slots(model, episodes, args.out / "slots-train.h5")
            val_cache = cached_slots(model, held_out, args.out / "slots-val.h5")
        layout = model.config.parser.layout
        batches = SlotBatches(
            cache,
            layout,
            model.text,
            training_frames(model.config, cache),
            recolor=args.recolor,
            # Drawn frames cannot be recoloured like this.
            color_spread=args.color_spread if args.image_weight == 0 else 0.0,
            color_jitter=args.color_jitter,
            place_jitter=args.place_jitter,
        )
        test = None
        if layout.explicit:
            questions = following_questions(val_cache, held_out, layout)
            test = FollowingTest(val_cache.padded(batches.frames).float(), questions, layout)
        following = fit(args, accelerator, model, batches, test, episodes if args.image_weight > 0 else None)
    finish(accelerator)
    return following


def assemble(args: PredictorTraining, captions: Iterable[str] = ()) -> TextOCVP:
    """A model with the trained parser and renderer, frozen, and a text encoder and a predictor to train.

    Args:
        captions: what a new text encoder is trained on.

    Raises:
        SettingsError: if an option would change the architecture of what is to be fine-tuned (but for a longer window),
            or of the parser.
    """
    trained = TextOCVP.from_pretrained(args.parser)
    if args.finetune:
        if args.preset is not None:
            raise SettingsError("finetune keeps the checkpoint's architecture: leave out preset")
        if trained.config.stage == "parser":
            raise SettingsError(f"{args.parser} has no trained predictor to finetune: leave out finetune")
        with allowed_settings():
            extend_window(trained, args.set)
        trained.text.train()
        trained.predictor.train()
        for part in (trained.parser, trained.renderer):
            part.requires_grad_(False)
        return trained
    config = trained.config
    if args.preset is not None:
        chosen = preset(args.preset)
        config = dataclasses.replace(config, name=chosen.name, text=chosen.text, predictor=chosen.predictor)
    for setting in args.set:
        if not setting.startswith(("predictor.", "text.")):
            raise SettingsError(
                f"{setting!r}: parser and renderer come trained; set predictor.* and text.* only"
            )
    with allowed_settings():
        config = with_settings(config, args.set)
        text = config.text.for_captions(captions)
        model = TextOCVP(dataclasses.replace(config, text=text, stage="predictor"))
    for part, source in ((model.parser, trained.parser), (model.renderer, trained.renderer)):
        part.load_state_dict(source.state_dict())
        part.requires_grad_(False).eval()
    return model


def training_frames(config: ModelConfig, cache: SlotCache) -> int:
    """Frames of a training sequence: one more than the past, so that every time code gets trained."""
    longest = int(cache.lengths.max())
    if config.predictor.causal:
        return config.predictor.window + 1
    return longest


def fit(
    args: PredictorTraining,
    accelerator: Accelerator,
    model: TextOCVP,
    batches: SlotBatches,
    test: FollowingTest | None,
    episodes: EpisodeFile | None = None,
) -> InstructionFollowing | None:
    """The training loop, from wherever `args.out` says it stopped; writes `out`/checkpoint.

    Args:
        model: parser and renderer frozen.
        batches: training slots.
        test: held-out questions; None for slots without explicit places, whose ends cannot be read off.
        episodes: the training episodes, to read the frames of the image loss from; None for no image loss.
    """
    layout = model.config.parser.layout
    std_C = None
    if model.predictor.standardized:
        if not args.finetune:  # else the units that it was trained in stay
            mean_C, std_C = batches.content_statistics()
            model.predictor.content_mean_C.copy_(mean_C)
            model.predictor.content_std_C.copy_(std_C)
        std_C = model.predictor.content_std_C
    run = Run(args, accelerator, PredictorStage(model))
    for step in run.steps("predictor"):
        mine = exercise(args, model.config.predictor, batches, step).select(run.rows).to(run.device)
        for part in run.parts():
            task = mine.select(part)
            asked = (task.seen_BTKD, task.batch.words, task.lesson.imagined)
            predicted_BSKD = run.module(*asked).float()
            loss = slot_loss(predicted_BSKD, task.true_BSKD, task.weights_BSK, layout, std_C, whole=1.0)
            total = loss.total(args.scale_weight, args.content_weight)
            if episodes is not None:
                drawn = image_error(model, episodes, task, predicted_BSKD)
                total = total + args.image_weight * run.share(part) * drawn
            run.backward(total, loss.figures())
        run.update(step, {"horizon": 1.0 + mine.lesson.imagined})

        if test is not None and run.is_main and (step + 1) % args.evaluate_every == 0:
            following = test.measure(model, args.evaluate_episodes)
            run.log(step, following.figures())
            tqdm.write(f"step {step + 1}: {following}")

    if not run.is_main:
        return None
    model.save_pretrained(args.out / "checkpoint")
    if test is None:
        return None
    following = test.measure(model)
    print(f"final: {following}")
    (args.out / "following.json").write_text(json.dumps(dataclasses.asdict(following), indent=2) + "\n")
    return following


def image_error(model: TextOCVP, episodes: EpisodeFile, task: Exercise, predicted_BSKD: Tensor) -> Tensor:
    """Mean squared error of the frames that `task` wants drawn; its gradient flows through the frozen renderer."""
    chosen_BF = torch.from_numpy(task.drawn_BF).to(predicted_BSKD.device)
    slots_BFKD = predicted_BSKD[torch.arange(len(chosen_BF))[:, None], chosen_BF]
    target_BF3HW = true_frames(episodes, task.batch, task.first + task.drawn_BF).to(predicted_BSKD.device)
    frames = model.renderer(slots_BFKD.flatten(0, 1)).frames_B3HW
    return (frames - target_BF3HW.flatten(0, 1)).square().mean()


@dataclass(frozen=True)
class Lesson:
    """What one update trains.

    Attributes:
        seen: how many true frames are given, from the first on.
        imagined: how many frames the model adds to them itself.
    """

    seen: int
    imagined: int


def next_lesson(
    args: PredictorTraining, predictor: PredictorConfig, step: int, frames: int, rng: np.random.Generator
) -> Lesson:
    """The lesson of update number `step`, for episodes of `frames` frames."""
    begin = round(args.steps * (1 - args.autoregressive)) if predictor.causal else 0
    if step < begin:
        return Lesson(frames - 1, 0)
    grown = min(1.0, (step - begin) / max(1.0, 0.8 * (args.steps - begin)))
    longest = min(frames - 1, args.horizon + round(grown * (frames - 1 - args.horizon)))
    horizon = int(rng.integers((longest + 1) // 2, longest + 1))
    if predictor.causal:
        return Lesson(frames - horizon, horizon - 1)
    return Lesson(int(rng.integers(1, frames - horizon + 1)), horizon - 1)


@dataclass
class Exercise:
    """A lesson with the episodes it is given on.

    Attributes:
        lesson: how much is seen and imagined.
        batch: the episodes.
        seen_BTKD: the slots that are given.
        forgetful_B: sequences whose frames do not see their past.
        true_BSKD: the slots that are to be predicted.
        weights_BSK: how much each of them counts; over all rows of the batch they sum to 1.
        drawn_BF: which of the S predicted frames are drawn for the image loss.
        first: number of the first predicted frame.
    """

    lesson: Lesson
    batch: SlotBatch
    seen_BTKD: Tensor
    forgetful_B: Tensor
    true_BSKD: Tensor
    weights_BSK: Tensor
    drawn_BF: np.ndarray
    first: int

    def select(self, rows: slice) -> Exercise:
        """Some rows of it."""
        return replace(
            self,
            batch=self.batch.select(rows),
            seen_BTKD=self.seen_BTKD[rows],
            forgetful_B=self.forgetful_B[rows],
            true_BSKD=self.true_BSKD[rows],
            weights_BSK=self.weights_BSK[rows],
            drawn_BF=self.drawn_BF[rows],
        )

    def to(self, device: torch.device) -> Exercise:
        return replace(
            self,
            batch=self.batch.to(device),
            seen_BTKD=self.seen_BTKD.to(device),
            forgetful_B=self.forgetful_B.to(device),
            true_BSKD=self.true_BSKD.to(device),
            weights_BSK=self.weights_BSK.to(device),
        )


def exercise(
    args: PredictorTraining, predictor: PredictorConfig, batches: SlotBatches, step: int
) -> Exercise:
    """What all processes together do in update number `step`."""
    rng = step_rng(args.seed, step)
    batch = batches.draw(rng, args.batch)
    lesson = next_lesson(args, predictor, step, batches.frames, rng)
    seen_BTKD = batches.noisy(rng, batch.slots_BTKD[:, : lesson.seen])
    forgetful_B = torch.from_numpy(rng.random(args.batch) < args.forgetful)
    last = lesson.seen + lesson.imagined  # the number of the last frame that is predicted
    # The causal form predicts from every frame the next, the window form only new frames.
    predictions = last if predictor.causal else lesson.imagined + 1
    drawn_BF = rng.integers(predictions, size=(args.batch, args.image_frames))
    first = last + 1 - predictions
    true_BTKD = batch.slots_BTKD[:, first - 1 : last + 1]
    weights_BSK = moving_weights(true_BTKD, batches.layout, args.moving, ever=lesson.imagined > 0)
    weights_BSK = weights_BSK / weights_BSK.sum().clamp(min=1e-6)
    return Exercise(lesson, batch, seen_BTKD, forgetful_B, true_BTKD[:, 1:], weights_BSK, drawn_BF, first)


def with_longer_window(predictor: SlotPredictor, window: int) -> SlotPredictor:
    """A copy that takes up to `window` frames. Within the old window it predicts what the original does.

    The learned time codes of the new frames start as copies of the last one that training reached, so that the first
    guess for frame 25 is what was learned about frame 24.

    Raises:
        ValueError: if the window would become shorter.
    """
    config = predictor.config
    if window < config.window:
        raise ValueError(
            f"the window can grow, not shrink: it is {config.window} frames, {window} were asked for"
        )
    grown = copy.deepcopy(predictor)
    grown.config = replace(config, window=window)
    rows = grown.config.time_codes
    if config.age_encoding == "learned":
        # The published form has one code more than its window has frames: no training ever reached that one.
        reached = predictor.ages.detach()[: config.window]
        grown.ages = nn.Parameter(torch.cat([reached, reached[-1:].expand(rows - config.window, -1)]))
    else:
        grown.register_buffer("ages", sinusoids(rows, config.dim).to(predictor.ages.device), persistent=False)
    return grown


def extend_window(model: TextOCVP, settings: Iterable[str]) -> None:
    """Change the trained model as `settings` say, which may be `predictor.window=FRAMES` only.

    Raises:
        ValueError: if a setting is another one, makes no sense, or would shorten the window.
    """
    settings = tuple(settings)
    for setting in settings:
        if not setting.startswith("predictor.window="):
            raise ValueError(
                f"{setting!r}: fine-tuning keeps the checkpoint's architecture; only predictor.window may grow"
            )
    config = with_settings(model.config, settings)
    model.predictor = with_longer_window(model.predictor, config.predictor.window)
    model.config = config
