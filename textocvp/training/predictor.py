"""Stage 2: train the text encoder and the predictor in slot space, with parser and renderer frozen.

    textocvp train predictor --parser runs/parser/checkpoint --data data/tabletop-train.h5 \\
        --val data/tabletop-val.h5 --out runs/predictor

Every episode is parsed once. The `causal` form then learns from all frames of an episode in one pass. First it is
teacher forced. Later it imagines a growing part of the episode, and predicts the true next frames from its own
imagined ones (dataset aggregation, Ross et al. 2011). With `predictor.direct` it imagines all frames from the first, in
training as in use. The published `window` form sees both ways, so it cannot be teacher forced in one pass: it learns
from rollouts, and the gradient flows back through them.

With `--outcome` a second predictor learns, from the first slots of an episode, its last ones at once; the text encoder
and the first predictor stay as they are. So a planner can ask where a sentence leads without imagining the way.
"""

import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from textocvp.config import with_settings
from textocvp.data.cache import cached_slots
from textocvp.data.slot_batches import SlotBatches, true_frames
from textocvp.layers import sinusoids
from textocvp.model import TextOCVP, check_parts
from textocvp.predictors import build_predictor
from textocvp.predictors.base import PredictorConfig, SlotPredictor
from textocvp.presets import preset
from textocvp.text.base import WordBatch
from textocvp.text.words import WordsConfig
from textocvp.training.evaluate_predictor import HeldOut, InstructionFollowing, Outcomes, SlotErrors, measure_outcomes
from textocvp.training.losses import acting, drawn_loss, moving_weights, slot_loss
from textocvp.training.run import (
    Run,
    SettingsError,
    TrainingSettings,
    allowed_settings,
    close_run,
    open_data,
    open_run,
    step_rng,
)


@dataclass(kw_only=True)
class PredictorTraining(TrainingSettings):
    """Train the text encoder and the predictor on the slots of a trained parser (stage 2)."""

    parser: Path
    """Checkpoint with the trained parser and renderer: a bundled name, a folder, or a hub id owner/name."""
    finetune: bool = False
    """Start from the text encoder and the predictor of the checkpoint `parser`, not from new ones. With
    `--set predictor.window=40` they learn longer rollouts, with `--set predictor.direct=true` to imagine every frame
    from the first. If the checkpoint foresees outcomes, its text encoder stays as it is, for these need it."""
    outcome: bool = False
    """Train the predictor of whole sentences, beside the one that the checkpoint `parser` has."""
    parse_every: int = 1
    """With `--outcome`, which learns from first and last frames: parse only every so many-th frame between them. With 3
    parsing takes a third of the time, and slots keep their objects as well."""
    preset: str | None = None
    """Take text encoder and predictor from this preset instead of from the parser's checkpoint."""
    steps: int = 1100
    batch: int = 32
    """Episodes an update, shared out among the processes."""
    learning_rate: float = 1e-3
    evaluate_every: int = 250
    evaluate_episodes: int = 200
    autoregressive: float = 0.4
    """Share of the updates, the last ones, that learn from imagined frames (`window`: all do; `direct`: none)."""
    horizon: int = 4
    """Frames of the first rollouts; grows linearly to the whole episode at four fifths of these updates."""
    moving: float = 20.0
    """How much more a slot counts that moves."""
    content_weight: float = 0.3
    """Weight of the error in content."""
    words_first: int = 0
    """Updates, the first ones, that learn only which slots act by the words: they are quick, and what slots then do
    is learned sooner."""
    image_weight: float = 0.0
    """Weight of the error of drawn frames of rollouts; its gradient flows through the frozen renderer."""
    image_frames: int = 2
    """How many frames of each rollout are drawn for it."""


class PredictorStage(nn.Module):
    """What stage 2 trains, as one module, so that several processes can share its gradients."""

    def __init__(self, model: TextOCVP, predictor: SlotPredictor | None = None) -> None:
        super().__init__()
        self.text, self.predictor = model.text, predictor or model.predictor
        if not self.predictor.uses_text:  # several processes would wait for gradients that never come
            self.text.requires_grad_(False)

    def forward(
        self,
        given_BTKD: Tensor,
        words: WordBatch,
        imagined: int,
        acts: tuple[Tensor, Tensor] | None = None,
        only_words: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Predictions (B, S, K, D), the last of which is of frame number T + imagined (the first is number 0).

        The `causal` form predicts from every given and every imagined frame the next, S = T + imagined. The `window`
        form only predicts new frames, S = imagined + 1. With them comes what the words get wrong about which slots act,
        if that is told: `acts`, see `acting`. With `only_words` nothing is predicted.
        """
        text = self.text.encode(words)
        told = None if acts is None else acts[1]
        words_loss = given_BTKD.new_zeros(())
        if acts is not None:
            known_BK = (acts[0] | ~acts[1]) & self.predictor.layout.used(given_BTKD[:, 0])
            words_loss = self.predictor.words_loss(text, given_BTKD[:, 0], acts[0], known_BK)
        if only_words:
            return given_BTKD[:, :0], words_loss
        if not self.predictor.config.causal:
            return self.predictor.rollout(given_BTKD, text, imagined + 1, acting_BK=told).slots_BSKD, words_loss
        if imagined and self.predictor.config.direct:
            given_BTKD = torch.cat([given_BTKD, given_BTKD[:, -1:].expand(-1, imagined, -1, -1)], dim=1)
        elif imagined:
            with torch.no_grad():
                imagined_BSKD = self.predictor.rollout(given_BTKD, text, imagined, acting_BK=told).slots_BSKD
            # Under autocast some versions of torch would reuse weights that were cast without a gradient.
            torch.clear_autocast_cache()
            given_BTKD = torch.cat([given_BTKD, imagined_BSKD], dim=1)
        return self.predictor(given_BTKD, text, told), words_loss


def schedule(
    args: PredictorTraining, form: PredictorConfig, step: int, frames: int, rng: np.random.Generator
) -> tuple[int, int]:
    """How many true frames update number `step` gives, from the first on, and how many the model then imagines itself.

    Args:
        form: of the predictor. What is `direct` imagines all of an episode from its first frame.
        frames: of an episode.
    """
    if form.direct:
        return 1, frames - 2
    causal = form.causal
    begin = round(args.steps * (1 - args.autoregressive)) if causal else 0
    if step < begin:
        return frames - 1, 0
    grown = min(1.0, (step - begin) / max(1.0, 0.8 * (args.steps - begin)))
    longest = min(frames - 1, args.horizon + round(grown * (frames - 1 - args.horizon)))
    horizon = int(rng.integers((longest + 1) // 2, longest + 1))
    return (frames - horizon if causal else int(rng.integers(1, frames - horizon + 1))), horizon - 1


def train(args: PredictorTraining) -> InstructionFollowing | SlotErrors | Outcomes | None:
    """Run or continue stage 2; writes `out`/checkpoint, a whole model.

    Returns:
        figures of all held-out episodes: instruction following, or slot errors where that cannot be measured. None on
        all processes but the main one.

    Raises:
        CheckpointError: if `parser` is no checkpoint.
        CacheError: if `out` holds slots of another parser or of other episodes.
        SettingsError: if the settings exclude each other, or this machine cannot do what they ask for.
    """
    accelerator = open_run(args.out, args.precision, some_unused=args.words_first > 0)
    torch.manual_seed(args.seed)
    trained = TextOCVP.from_pretrained(str(args.parser))
    with open_data(args, trained.config.parser.image_size, "parser.image_size") as (episodes, held_out):
        model = assemble(args, trained, episodes.instructions, episodes.vocabulary).to(accelerator.device)
        predictor = model.outcome if args.outcome else model.predictor
        assert predictor is not None
        layout, causal = model.config.parser.layout, predictor.config.causal
        share = (accelerator.process_index, accelerator.num_processes)
        slots = cached_slots(model, episodes, args.out / "slots-train", *share, every=args.parse_every)
        val_slots = cached_slots(model, held_out, args.out / "slots-val", *share, every=args.parse_every)
        accelerator.wait_for_everyone()
        # One frame more than the past, so that every time code gets trained.
        longest = int(slots.lengths.max())
        frames = predictor.config.window + 1 if causal else longest
        ends = 2, max(longest, int(val_slots.lengths.max())) - 1  # first and last frame, however long the episode is
        frames, every = ends if args.outcome else (frames, 1)
        if longest > every * (frames - 1) + 1 and accelerator.is_main_process:
            warnings.warn(
                f"{(slots.lengths > frames).mean():.0%} of the episodes of {args.data} are longer than the "
                f"predictor's window, and their ends are cut off: nothing is learned after frame {frames}, the "
                f"longest has {longest}; --set predictor.window={longest - 1} takes all",
                UserWarning,
                stacklevel=2,
            )
        batches = SlotBatches(slots, layout, model.text, frames, every, device=accelerator.device)
        std_C = predictor.content_std_C if predictor.standardized else None
        if std_C is not None and not args.finetune:  # which keeps the units in which the predictor was trained
            mean_C, deviation_C = batches.content_statistics()
            predictor.content_mean_C.copy_(mean_C)
            std_C.copy_(deviation_C)
        held = HeldOut.of(held_out, val_slots, layout, frames, every)
        measure = partial(measure_outcomes, model, held) if args.outcome else partial(held.measure, model)
        run = Run(args, accelerator, PredictorStage(model, predictor))

        for step in run.steps("predictor"):
            # Every process draws the whole batch, and then computes its rows of it.
            rng = step_rng(args.seed, step)
            batch = batches.draw(rng, args.batch)
            given, imagined = schedule(args, predictor.config, step, frames, rng)
            given_BTKD = batch.slots_BTKD[:, :given]
            if not predictor.config.direct:  # which never reads what it got a little wrong
                given_BTKD = batches.noisy(rng, given_BTKD)
            rng.random(args.batch)  # unused; without it a seed would give other runs than it always did
            # The causal form predicts from every frame the next, the window form only new frames.
            first, last = 1 if causal else given, given + imagined  # numbers of the frames that are predicted
            drawn_BF = rng.integers(last + 1 - first, size=(args.batch, args.image_frames))
            true_BTKD = batch.slots_BTKD[:, first - 1 : last + 1]
            weights_BSK = moving_weights(true_BTKD, layout, args.moving, ever=imagined > 0)
            weights_BSK = weights_BSK / weights_BSK.sum().clamp(min=1e-6)
            only_words = predictor.learns_words and step < args.words_first
            acts = acting(batch.slots_BTKD, layout, batches.content_std_C) if predictor.learns_words else None

            for rows in run.micro_batches(of_batch=True):
                slots_BTKD, target_BSKD, weights = (
                    whole[rows].to(run.device) for whole in (given_BTKD, true_BTKD[:, 1:], weights_BSK)
                )
                words = batch.words.select(rows).to(run.device)
                told = None if acts is None else (acts[0][rows].to(run.device), acts[1][rows].to(run.device))
                predicted_BSKD, words_loss = run.module(slots_BTKD, words, imagined, told, only_words)
                if only_words:
                    run.backward(run.weight(rows) * words_loss, {"words": words_loss})
                    continue
                predicted_BSKD = predicted_BSKD.float()
                loss = slot_loss(predicted_BSKD, target_BSKD, weights, layout, std_C)
                words_loss = run.weight(rows) * words_loss
                total = loss.total(args.content_weight) + words_loss
                if args.image_weight > 0:
                    times_BF = every * (first + drawn_BF[rows])
                    true_BF3HW = true_frames(episodes, batch.episodes_B[rows], times_BF, batch.channels_B3[rows])
                    image = drawn_loss(model.renderer, predicted_BSKD, drawn_BF[rows], true_BF3HW)
                    total = total + args.image_weight * run.weight(rows) * image
                run.backward(total, vars(loss) | ({} if told is None else {"words": words_loss}))
            run.update(step, {"horizon": 1.0 + imagined})
            run.evaluate(step, measure)
        metrics = run.finish(model.save_pretrained, measure, "outcomes.json" if args.outcome else held.file)
    close_run(accelerator)
    return metrics


def assemble(
    args: PredictorTraining, trained: TextOCVP, captions: Iterable[str] = (), vocabulary: Iterable[str] = ()
) -> TextOCVP:
    """A model with the trained parser and renderer, frozen, and a text encoder and a predictor to train.

    Args:
        trained: the checkpoint `args.parser`.
        captions: what the text encoder will learn from.
        vocabulary: further words that a new text encoder must have a place for.

    Raises:
        SettingsError: if an option would change the architecture of the parser, or of what is fine-tuned (but for a
            longer window).
    """
    config = trained.config
    if args.parse_every > 1 and not args.outcome:
        raise SettingsError("--parse-every goes with --outcome: all else learns from every frame")
    if args.outcome:
        model = with_outcome(args, trained)
        meet(model, captions)
    elif args.finetune:
        if args.preset is not None:
            raise SettingsError("finetune keeps the checkpoint's architecture: leave out preset")
        if config.stage == "parser":
            raise SettingsError(f"{args.parser} has no trained predictor to finetune: leave out finetune")
        model = trained
        with allowed_settings():
            extend(model, args.set)
        meet(model, captions)
        if model.outcome is None:
            model.text.train()
        else:  # it was trained with this encoder, and would not understand another
            model.text.requires_grad_(False).eval()
        model.predictor.train()
    else:
        if args.preset is not None:
            chosen = preset(args.preset)
            config = replace(config, name=chosen.name, text=chosen.text, predictor=chosen.predictor)
        for setting in args.set:
            if not setting.startswith(("predictor.", "text.")):
                raise SettingsError(f"{setting!r}: parser and renderer come trained; set predictor.* and text.* only")
        with allowed_settings():
            config = with_settings(config, args.set)
            text = config.text.for_captions(captions, vocabulary)
            model = TextOCVP(replace(config, text=text, stage="predictor"))
        model.parser.load_state_dict(trained.parser.state_dict())
        model.renderer.load_state_dict(trained.renderer.state_dict())
        model.restorer = trained.restorer
    for part in (model.parser, model.renderer, model.restorer):
        if part is not None:
            part.requires_grad_(False).eval()
    return model


def meet(model: TextOCVP, captions: Iterable[str]) -> None:
    """Note which forms of sentences the model has been trained on, these captions' too."""
    if isinstance(model.text.config, WordsConfig):
        model.text.config = model.text.config.met(captions)
        model.config = replace(model.config, text=model.text.config)


def with_outcome(args: PredictorTraining, trained: TextOCVP) -> TextOCVP:
    """The model with a predictor of whole sentences to train, and all else frozen; errors as `assemble`.

    The new predictor is built as the first one, but for its window, which is one frame, and for `--set outcome.*`.
    """
    config = trained.config
    if config.stage == "parser" or args.preset is not None:
        raise SettingsError(f"--outcome goes with a trained predictor, which {args.parser} must have, and no preset")
    if args.finetune and (config.outcome is None or args.set):
        raise SettingsError("--finetune --outcome goes on with an outcome that is there, as it is: leave out set")
    for setting in args.set:
        if not setting.startswith("outcome."):
            raise SettingsError(f"{setting!r}: with --outcome set outcome.* only")
    if not args.finetune:
        with allowed_settings():
            config = with_settings(replace(config, outcome=replace(config.predictor, window=1)), args.set)
            check_parts(config)
            assert config.outcome is not None
            trained.config = config
            trained.outcome = build_predictor(config.outcome, config.parser.layout, config.text.dim)
    trained.requires_grad_(False).eval()
    assert trained.outcome is not None
    trained.outcome.requires_grad_(True).train()
    return trained


def extend(model: TextOCVP, settings: Iterable[str]) -> None:
    """Let the predictor take more frames, as `predictor.window=FRAMES` says, or read others (`predictor.direct`).

    Within the old window it has the weights that it had.

    Raises:
        ValueError: if a setting is another one, makes no sense, or would shorten the window.
    """
    for setting in (settings := tuple(settings)):
        if not setting.startswith(("predictor.window=", "predictor.direct=")):
            raise ValueError(
                f"{setting!r}: fine-tuning keeps the checkpoint's architecture; only predictor.window may grow "
                "(predictor.window=40) and predictor.direct change (predictor.direct=true)"
            )
    config, predictor = with_settings(model.config, settings), model.predictor
    old, new = model.config.predictor, config.predictor
    if new.window < old.window:
        raise ValueError(f"the window can grow, not shrink: it is {old.window} frames, {new.window} were asked for")
    model.config, predictor.config = config, new
    if new.age_encoding == "learned":
        # The codes of new frames start as the last one that training reached. The published form has one code more
        # than its window has frames: no training ever reached that one.
        reached = predictor.ages.detach()[: old.window]
        predictor.ages = nn.Parameter(torch.cat([reached, reached[-1:].expand(new.time_codes - old.window, -1)]))
    else:
        codes = sinusoids(new.time_codes, new.dim).to(predictor.ages.device)
        predictor.register_buffer("ages", codes, persistent=False)
