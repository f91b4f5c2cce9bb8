"""The parts of a device's benchmark: its gate, its targets, what it knows of the device."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import candidates
import cases
import devices
import document_device
import frames
import gate
import gate_device
import machine
import peers
import run
import suites
from candidates import CONTINUOUS, LEVELS
from device_doubles import Processor, tiny, tiny_plan
from plan import Limits
from rows import Row
from suites import series
from surfconv_ops import SurfConv2d
from timing import Timing, interleave

ONCE = Limits(seconds=0.0, minimum=2, maximum=2)


@pytest.fixture(autouse=True)
def _tiny(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with tiny(monkeypatch):
        yield


def failures(name: str = "float32", subject: str = CONTINUOUS) -> list[str]:
    layer = cases.GPU["c4"]
    scene = candidates.scene_of(layer, frames.make_scene, frames.RANDOM)
    checks = gate_device.against_reference(
        layer, subject, scene, name, list(cases.LAYOUTS), Processor()
    )
    assert len(checks) == 1 + 2 * 6
    return [check.what for check in checks if not check.passed]


@pytest.mark.parametrize("name", devices.NUMERICS)
def test_the_gate_is_green_in_all_numerics(name: str) -> None:
    for subject in (CONTINUOUS, candidates.SAME_LEVEL):
        assert not failures(name, subject)


def test_the_gate_sees_wrong_operators_layers_and_references(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    right = gate.surf_conv2d
    with monkeypatch.context() as patch:
        # What one wrong tap does, and no rounding.
        patch.setattr(gate, "surf_conv2d", lambda *a, **o: 1.01 * right(*a, **o))
        for name in devices.NUMERICS:
            assert any(what.endswith(f"{name}: output") for what in failures(name))
    with monkeypatch.context() as patch:
        # tf32's own error, where true float32 was asked for.
        def shortened(input: torch.Tensor, *a: object, **o: object) -> torch.Tensor:
            short = (input.detach().view(torch.int32) & ~0x1FFF).view(torch.float32)
            return right(input + (short - input).detach(), *a, **o)

        patch.setattr(gate, "surf_conv2d", shortened)
        assert any("output" in what for what in failures())
    with monkeypatch.context() as patch:
        forward = SurfConv2d.forward
        patch.setattr(SurfConv2d, "forward", lambda self, x, z: forward(self, x, 1.02 * z))
        assert failures() and all(what.endswith(": layer") for what in failures())
    with monkeypatch.context() as patch:
        reference = gate_device.reference.surf_conv2d
        patch.setattr(
            gate_device.reference,
            "surf_conv2d",
            lambda *a, scale, **o: reference(*a, scale=scale * (1 + 1e-6), **o),
        )
        assert any("reference at points" in what for what in failures())


def test_the_gate_holds_every_timed_shape_peers_and_nets() -> None:
    jobs = gate_device.gate(tiny_plan(quick=False), Processor())
    labels = [label for label, _ in jobs]
    for layer in ("c4", "c8", "frame"):
        assert sum(label.startswith(f"{layer} ") for label in labels) == 8
    checks = [check for label, job in jobs if label in ("c8", "peers", "net") for check in job()]
    assert not [check for check in checks if not check.passed]
    told = " ".join(check.what for check in checks)
    for name in ("at scale 1", "DeformConv2d agrees", f"{LEVELS}: on the device", peers.PYRAMID):
        assert name in told


def test_wins_and_losses_target_by_target() -> None:
    def row(case: str, subject: str, ratio: float, verdict: str) -> Row:
        leads = subject == peers.DEFORM
        return Row(
            suite="s",
            table="t",
            case=case,
            subject=subject,
            direction="forward",
            layout="contiguous" if leads else "channels_last",
            dtype="tf32",
            baseline=CONTINUOUS if leads else "nn.Conv2d, channels_last",
            ratio=ratio,
            target=3.0 if leads else 1.6,
            target_sense="at least" if leads else "at most",
            verdict=verdict,
        )

    found = [row("c64 8x", CONTINUOUS, 1.2, "met"), row("c8 8x", CONTINUOUS, 1.9, "missed")]
    found += [row("c64 8x", peers.DEFORM, 3.5, "met"), row("c8 8x", peers.DEFORM, 9.0, "met")]
    assert document_device.by_target(found)[2:] == [
        "| s | SurfConv2d continuous | forward | at most 1.6 x nn.Conv2d's time | 1 | **1** "
        "| 1.20 (c64, tf32) | 1.90 (c8, tf32) |",
        "| s | deform_conv2d | forward | at least 3 x SurfConv2d continuous's time | 2 | 0 "
        "| 9.00 (c8, tf32) | 3.50 (c64, tf32) |",
    ]


def test_numerics_are_set_and_restored() -> None:
    matmul, cudnn = torch.backends.cuda.matmul, torch.backends.cudnn

    def state() -> tuple[bool, bool, bool]:
        return matmul.allow_tf32, cudnn.allow_tf32, cudnn.benchmark

    before = state()
    for name, allowed in (("float32", False), ("tf32", True), ("bfloat16", True)):
        with devices.numerics(name) as dtype:
            assert state() == (allowed, allowed, True)
            assert str(dtype) == f"torch.{name}".replace("tf32", "float32")
        assert state() == before
    failing = devices.numerics("tf32")
    failing.__enter__()
    assert failing.__exit__(KeyError, KeyError("inside"), None) is False
    assert state() == before


def test_a_timing_keeps_what_the_device_and_the_processor_took() -> None:
    class Clock:
        def time(self, run: object) -> tuple[float, float]:
            return 0.5, 0.125

    timing = interleave({"call": lambda: None}, ONCE, clock=Clock())["call"]
    assert timing == Timing([0.5, 0.5], [0.125, 0.125])
    assert series.host_note(timing) == "processor 125.00 ms"


def test_suites_belong_to_their_device(capsys: pytest.CaptureFixture[str]) -> None:
    assert run.parse_arguments([]).suites == list(suites.SUITES)
    assert run.parse_arguments(["--device", "cuda"]).suites == list(suites.DEVICE_SUITES)
    for arguments in (["--suites", "gpu_net"], ["--device", "cuda", "--suites", "layers"]):
        with pytest.raises(SystemExit) as stopped:
            run.parse_arguments(arguments)
        assert stopped.value.code == 2
        assert f"{arguments[-1]} is not measured with --device" in capsys.readouterr().err


def test_cudas_clock_and_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []

    class Event:
        def __init__(self, enable_timing: bool) -> None:
            assert enable_timing

        def record(self) -> None:
            order.append("event")

        def synchronize(self) -> None:
            order.append("wait")

        def elapsed_time(self, end: Event) -> float:
            assert order[-1] == "wait" and end is not self
            return 4.0

    class Buffer:
        def zero_(self) -> None:
            order.append("flush")

    class About:
        L2_cache_size = 300 * 2**20

    def buffer(size: int, *, dtype: torch.dtype, device: torch.device) -> Buffer:
        assert size * dtype.itemsize == 2 * About.L2_cache_size and device.index == 3
        return Buffer()

    used = iter((10, 70))
    monkeypatch.setattr(torch, "empty", buffer)
    for name, fake in {
        "current_device": lambda: 3,
        "get_device_properties": lambda _: About,
        "synchronize": lambda _: order.append("idle"),
        "Event": Event,
        "reset_peak_memory_stats": lambda _: order.append("reset"),
        "memory_allocated": lambda _: next(used),
        "max_memory_allocated": lambda _: next(used),
    }.items():
        monkeypatch.setattr(torch.cuda, name, fake)
    device = devices.Cuda()
    seconds, host = device.time(lambda: order.append("call"))
    assert seconds == 0.004 and 0 < host < 1
    assert order == ["idle", *["flush"] * devices.FLUSHES, "event", "call", "event", "wait"]
    order.clear()
    assert device.peak(lambda: order.append("call")) == 60
    assert order == ["idle", "reset", "call", "idle"]


def test_the_device_is_described(monkeypatch: pytest.MonkeyPatch) -> None:
    class About:
        name, major, minor, multi_processor_count = "a GPU", 9, 0, 132
        total_memory, L2_cache_size = 80 * 2**30, 50 * 2**20

    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _: About)
    monkeypatch.setitem(sys.modules, "triton", None)
    facts = machine.gpu(torch.device("cpu"))
    assert facts["gpu"] == "a GPU" and facts["gpu_compute_capability"] == "9.0"
    assert facts["gpu_l2_mib"] == 50 and facts["torchvision"] == "a double's"
    assert {"driver", "cuda", "cudnn"} <= set(facts)
    assert facts["triton"].startswith("none (ModuleNotFoundError")
