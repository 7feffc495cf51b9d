"""Training at scale: the same run on one process or several, in one part or many, read by workers, stopped or not."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.textocvp.training import both_stages
from tests.textocvp.training.runs import losses, parser_run, predictor_run, same_weights, train, weights
from textocvp import cli
from textocvp.data.episodes import EpisodeFile
from textocvp.data.prefetch import prefetch
from textocvp.training import predictor
from textocvp.training.clips import ClipReader
from textocvp.training.run import DivergedError, Run, SettingsError


def drawing_run(folder: Path, out: str, **changes):
    return predictor_run(folder, out, image_weight=1.0, **changes)


def assert_same_run(one: Path, other: Path, *, exactly: bool = False) -> None:
    a, b = weights(one), weights(other)
    assert a.keys() == b.keys()
    for name in a:
        # Keys' biases change no attention: their gradients are rounding errors, and Adam makes steps of those.
        close = 1e-3 if name.endswith("qkv.bias") else 1e-5
        torch.testing.assert_close(a[name], b[name], atol=0 if exactly else close, rtol=0, msg=name)
    np.testing.assert_allclose(losses(one), losses(other), rtol=0 if exactly else 1e-5)


def test_two_processes_are_the_same_run_as_one(folder: Path) -> None:
    """The command that people use, started twice by torchrun, meeting over gloo."""
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2"]
    command = [*launcher, "-m", "tests.textocvp.training.both_stages", str(folder), "two"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as started:
        both_stages.main(folder, "one")
        printed, _ = started.communicate(timeout=600)
    assert started.returncode == 0, printed[-3000:]
    for run in both_stages.RUNS:
        one, two = folder / "one" / run, folder / "two" / run
        assert (two / "state" / "random_states_1.pkl").exists(), "there was no second process"
        assert len(losses(two)) == both_stages.STEPS
        assert_same_run(one, two)


@pytest.mark.parametrize("make", [parser_run, drawing_run])
def test_micro_batches_add_up_to_the_batch(folder: Path, make) -> None:
    whole, parts = make(folder, "whole"), make(folder, "parts", accumulate=3)  # of 1, 2 and 2 rows
    train(whole)
    train(parts)
    assert_same_run(whole.out, parts.out)


def test_workers_change_nothing(folder: Path) -> None:
    alone, helped = parser_run(folder, "alone"), parser_run(folder, "helped", workers=2)
    train(alone)
    train(helped)
    assert_same_run(alone.out, helped.out, exactly=True)


def test_workers_read_the_steps_in_their_order(folder: Path) -> None:
    args = parser_run(folder, "out", stride=3)
    with EpisodeFile(args.data) as episodes:
        reader = ClipReader(episodes, args, slice(0, args.batch))
        expected = [reader(step) for step in range(4, 11)]
        for workers in (1, 3):
            read = list(prefetch(reader, range(4, 11), workers))
            assert len(read) == len(expected)
            for a, b in zip(read, expected, strict=True):
                assert torch.equal(a.frames_BTHW3, b.frames_BTHW3) and torch.equal(a.seeds_B, b.seeds_B)
    assert not torch.equal(expected[0].frames_BTHW3, expected[1].frames_BTHW3)


def test_workers_outlive_the_signal_that_ends_a_run(folder: Path) -> None:
    """A cluster sends it to whole process groups, and without workers the last update could not be finished."""
    args = parser_run(folder, "out")
    before = set(multiprocessing.active_children())  # what other tests left running is none of this one's business
    with EpisodeFile(args.data) as episodes:
        batches = iter(prefetch(ClipReader(episodes, args, slice(None)), range(40), 1))
        next(batches)
        (worker,) = set(multiprocessing.active_children()) - before
        try:
            os.kill(worker.pid, signal.SIGTERM)
            worker.join(timeout=1)
            assert worker.is_alive() and len(list(batches)) == 39
            worker.join(timeout=30)
            assert not worker.is_alive()
        finally:  # pytest would wait for it for ever
            worker.kill()


def test_shares_of_the_clips_are_the_clips(folder: Path) -> None:
    args = parser_run(folder, "out")
    with EpisodeFile(args.data) as episodes:
        whole = ClipReader(episodes, args, slice(0, 5))(7)
        shares = [ClipReader(episodes, args, rows)(7) for rows in (slice(0, 2), slice(2, 5))]
    assert whole.frames_BTHW3.shape == (5, 2, 32, 32, 3) and len(set(whole.seeds_B.tolist())) == 5
    assert torch.equal(torch.cat([share.frames_BTHW3 for share in shares]), whole.frames_BTHW3)
    assert torch.equal(torch.cat([share.seeds_B for share in shares]), whole.seeds_B)


@pytest.mark.parametrize("make", [parser_run, drawing_run])
def test_a_terminated_run_saves_itself_and_continues_exactly(
    folder: Path, monkeypatch: pytest.MonkeyPatch, make
) -> None:
    """SIGTERM is what a cluster sends before it takes a machine away."""
    straight, resumed = (make(folder, name, accumulate=2, steps=4) for name in ("straight", "resumed"))
    train(straight)

    update = Run.update

    def asked_to_end(self, step, metrics=None):
        update(self, step, metrics)
        if step == 1:
            os.kill(os.getpid(), signal.SIGTERM)

    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(Run, "update", asked_to_end)
    with pytest.raises(SystemExit) as stop:
        train(resumed)
    assert stop.value.code == 143 and signal.getsignal(signal.SIGTERM) is before
    assert not (resumed.out / "checkpoint").exists()
    monkeypatch.setattr(Run, "update", update)
    steps = []
    monkeypatch.setattr(Run, "update", lambda *args: steps.append(args[1]) or update(*args))
    torch.rand(7)  # the world goes on
    train(resumed)
    assert steps == [2, 3]
    assert same_weights(straight.out, resumed.out)


def test_brain_floats_are_close_to_floats(folder: Path) -> None:
    for make in (parser_run, drawing_run):
        plain, mixed = make(folder, make.__name__), make(folder, make.__name__ + "-bf16", precision="bf16")
        train(plain)
        train(mixed)
        assert losses(plain.out) != losses(mixed.out)
        np.testing.assert_allclose(losses(plain.out), losses(mixed.out), rtol=0.03)


def test_what_cannot_be_done_is_said(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    with pytest.raises(SettingsError, match=r"batch of 5 .* 1 processes x 6 micro-batches"):
        train(parser_run(folder, "out", accumulate=6))
    with pytest.raises(SettingsError, match="accumulate must be at least 1"):
        train(replace(parser_run(folder, "out"), accumulate=0))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    files = ["--data", str(folder / "train.h5"), "--val", str(folder / "val.h5")]
    arguments = ["train", "parser", *files, "--out", str(folder / "half"), "--precision", "fp16"]
    assert cli.main(arguments) == 1
    assert "fp16 needs a GPU" in capsys.readouterr().err and not (folder / "half").exists()


def test_a_run_does_not_write_over_what_it_begins_with(folder: Path) -> None:
    train(parser_run(folder, "begun", steps=1))
    checkpoint = folder / "begun/checkpoint"
    before = (checkpoint / "model.safetensors").read_bytes()
    for begin in (partial(predictor_run, parser=checkpoint), partial(parser_run, start=checkpoint)):
        with pytest.raises(SettingsError, match=r"begun/checkpoint lies in --out .*begun, which this run writes"):
            begin(folder, "begun", fresh=True)
    assert (checkpoint / "model.safetensors").read_bytes() == before


def test_a_run_with_other_settings_is_not_taken_for_the_same(folder: Path) -> None:
    """The first difference is named; more steps are no difference."""
    run = predictor_run(folder, "settings", steps=2)
    train(run)
    before = weights(run.out)
    with pytest.raises(SettingsError, match=r"holds a run with moving 20\.0, not 5\.0: give the same settings"):
        train(replace(run, steps=3, moving=5.0))
    assert all(torch.equal(tensor, before[name]) for name, tensor in weights(run.out).items())
    train(replace(run, steps=3))
    assert len(losses(run.out)) == 3


@pytest.mark.parametrize(
    ("setting", "least"), [("steps", 0), ("batch", 1), ("seed", 0), ("evaluate_every", 1), ("episodes", 1)]
)
def test_settings_without_sense_are_refused_before_anything_is_written(folder: Path, setting, least) -> None:
    option = setting.replace("_", "-")
    with pytest.raises(SettingsError, match=f"--{option} is {least - 1}: must be at least {least}"):
        predictor_run(folder, "senseless", **{setting: least - 1})
    assert not (folder / "senseless").exists()


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("learning_rate", 0.0),
        ("learning_rate", float("inf")),
        ("learning_rate", 1e30),
        ("learning_rate", float("nan")),
        ("clip_norm", 0.0),
        ("batch", 10**8),
        ("seed", 2**64),
    ],
)
def test_settings_that_teach_nothing_or_too_much_are_refused(folder: Path, setting: str, value: float) -> None:
    with pytest.raises(SettingsError, match=f"--{setting.replace('_', '-')} is .*: must be at least .*"):
        predictor_run(folder, "senseless", **{setting: value})
    assert not (folder / "senseless").exists()


def test_weights_of_pixels_are_not_negative(folder: Path) -> None:
    with pytest.raises(SettingsError, match=r"--thing-weight is -5\.0: must be at least 0\.0"):
        parser_run(folder, "senseless", thing_weight=-5.0)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("settings.json", b'{"episodes": 20'),
        ("state/model.safetensors", b"xxxx"),
        ("state/optimizer.bin", b"x"),
        ("state/step.json", b'{"next_step": "one"}'),
    ],
)
def test_a_damaged_run_is_said_and_may_be_thrown_away(folder: Path, name: str, content: bytes) -> None:
    run = predictor_run(folder, "damaged", steps=1)
    train(run)
    (run.out / name).write_bytes(content)
    with pytest.raises(SettingsError, match=r"damaged holds a run that cannot be gone on with: .* --fresh"):
        train(replace(run, steps=2))
    assert (run.out / name).read_bytes() == content
    train(replace(run, steps=2, fresh=True))


def test_a_finished_run_says_that_nothing_is_trained(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = predictor_run(folder, "finished", steps=1)
    train(run)
    assert "is finished" not in capsys.readouterr().out
    train(run)
    assert "is finished (1 updates): nothing more is trained" in capsys.readouterr().out


def test_weights_that_are_no_numbers_are_never_saved(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An update may break them although its own gradient was finite."""
    update = Run.update

    def broken(self: Run, step: int, metrics: object = None) -> None:
        update(self, step)
        with torch.no_grad():
            next(self.module.parameters()).fill_(float("inf"))

    monkeypatch.setattr(Run, "update", broken)
    run = predictor_run(folder, "broken", steps=1)
    with pytest.raises(DivergedError, match="before step 1: a weight is not finite"):
        train(run)
    assert not (run.out / "state").exists() and not (run.out / "checkpoint").exists()


def test_a_run_that_diverges_ends_and_keeps_its_last_good_state(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = predictor_run(folder, "diverging", steps=2)
    train(run)
    before = {path: path.read_bytes() for path in (run.out / "checkpoint").iterdir()}
    loss = predictor.slot_loss

    def poisoned(*args):
        terms = loss(*args)
        return replace(terms, position=terms.position * float("nan"))

    monkeypatch.setattr(predictor, "slot_loss", poisoned)
    with pytest.raises(DivergedError, match="diverged at step 3: the gradient is not finite"):
        train(replace(run, steps=4))
    assert all(path.read_bytes() == content for path, content in before.items())
