"""The benchmark of a device on the processor, at tiny sizes: all of it but CUDA's own clock."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import candidates
import cases
import charts
import devices
import gate
import peers
import report
import run
import suites
import targets
from candidates import BASELINE, CONTINUOUS, LEVELS
from device_doubles import SHRINK, Processor, tiny, tiny_plan
from plan import DEVICE_FULL_SECONDS, DEVICE_QUICK_SECONDS, Limits, make_plan
from rows import Row
from suites import gpu_first, series
from surfconv_ops import SurfConv2d

ROOT = Path(__file__).parents[1]
#: The layers as they are, before the tests make them small.
REAL_LAYERS = {str(layer): layer for layer in cases.GPU.values()}
ONCE = Limits(seconds=0.0, minimum=2, maximum=2)
STEP = "forward + backward"


@pytest.fixture(autouse=True)
def _tiny(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with tiny(monkeypatch):
        yield


def measure(name: str, quick: bool = True) -> list[Row]:
    suite = suites.device_suites(Processor())[name]
    return [row for job in suite.jobs(tiny_plan(name, quick=quick)) for row in job.measure(ONCE)]


def check_rows(found: list[Row], name: str) -> None:
    assert {row.suite for row in found} == {name}
    assert max(Counter(row.key for row in found).values()) == 1
    for row in found:
        assert 0 < row.low <= row.value <= row.high, row
        judged = row.dtype in targets.GPU_NUMERICS and row.target is not None
        assert (row.verdict != "") == judged, row
        if judged and row.ratio is not None:
            met = row.ratio >= row.target if row.subject == peers.DEFORM else (
                row.ratio <= row.target
            )  # fmt: skip
            assert row.verdict == ("met" if met else "missed"), row


def test_layers_stand_beside_everything_that_one_could_pick() -> None:
    found = measure("gpu_layers", quick=False)
    check_rows(found, "gpu_layers")
    everything = {BASELINE, CONTINUOUS, LEVELS, candidates.SAME_LEVEL, *series.PEERS}
    for layer in cases.GPU.values():
        for numerics in devices.NUMERICS:
            for direction in ("forward", STEP):
                place = (str(layer.shrunk(SHRINK)), numerics, direction)
                own = [row for row in found if (row.case, row.dtype, row.direction) == place]
                extra = {series.FIXED_DEPTH} if direction == STEP else set()
                assert {row.subject for row in own} == everything | extra
                assert sum(row.layout == "contiguous" for row in own) == 4
                bases = {row.baseline for row in own if row.layout == "contiguous"}
                assert bases == {"", f"{BASELINE}, contiguous", f"{CONTINUOUS}, channels_last"}
                goals = {(row.subject, row.target) for row in own if row.target is not None}
                price, lead = (1.6, 3.0) if direction == "forward" else (2.0, 4.0)
                ours = {s for s in everything | extra if s.startswith("SurfConv2d")}
                expected = {(peers.DEFORM, lead), *((subject, price) for subject in ours)}
                assert goals == (expected if numerics in ("tf32", "bfloat16") else set())
    wide = {row.dtype for row in found if "computed in float32" in row.note}
    assert wide == {"bfloat16"}


def test_memory_is_judged_against_conv2d() -> None:
    found = measure("gpu_memory")
    check_rows(found, "gpu_memory")
    values = {(row.subject, row.dtype, row.direction): row for row in found}
    size = cases.GPU["c8"].shrunk(SHRINK)
    output = size.pixels * size.channels_out
    for numerics, width in (("tf32", 4), ("bfloat16", 2)):
        plain = values[BASELINE, numerics, "forward"]
        assert plain.value * 2**20 == output * width and plain.ratio is None
        ours = values[CONTINUOUS, numerics, "forward"]
        assert ours.value * 2**20 >= width * output + 4 * size.pixels
        assert ours.ratio == pytest.approx(ours.value / plain.value) and ours.target == 1.15
        # The depth's gradient is of the depth's size, and its scale's as well.
        less = (
            values[CONTINUOUS, numerics, STEP].value
            - values[series.FIXED_DEPTH, numerics, STEP].value
        )
        assert less * 2**20 >= 2 * 4 * size.pixels
        reference = values[peers.REFERENCE, numerics, STEP]
        assert reference.ratio is not None and reference.ratio > 9 and not reference.verdict


@pytest.mark.parametrize("name", ["gpu_net", "gpu_conv3d"])
def test_nets_and_volumes(name: str) -> None:
    found = measure(name)
    check_rows(found, name)
    assert {row.dtype for row in found} == set(targets.GPU_NUMERICS)
    if name == "gpu_net":
        assert {row.subject for row in found} == {BASELINE, LEVELS, CONTINUOUS, peers.PYRAMID}
        assert {row.unit for row in found} == {"ms", "MiB"}
        assert sum(bool(row.verdict) for row in found) == 2 * 2 * 2 * 2
        jobs = suites.device_suites(Processor())[name].jobs(tiny_plan(name, quick=False))
        job = next(job for job in jobs if job.label == "batch 1 float16 forward")
        assert not any(row.verdict for row in job.measure(ONCE))
    else:
        assert {row.subject for row in found} == {CONTINUOUS, peers.CONV3D}


def test_first_calls_are_timed_in_processes_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[tuple[list[str], str, bool]] = []

    def process(arguments: list[str], cache: str) -> dict[str, object]:
        started.append((arguments, cache, Path(cache).is_dir()))
        if len(started) == 2:
            return {}
        return {name: {"forward": [2.5, 0.5], STEP: [4.0, 1.0]} for name in (BASELINE, CONTINUOUS)}

    monkeypatch.setattr(gpu_first, "run_process", process)
    found = measure("gpu_first")
    (one, two) = started
    assert one == two and one[2] and one[0][:4] == ["--device", "cpu", "--numerics", "bfloat16"]
    assert not Path(one[1]).exists()
    shown = {(row.subject, row.direction): (row.value, row.unit, row.note) for row in found}
    assert shown[f"{CONTINUOUS}, nothing compiled before", STEP][:2] == (4.0, "s")
    assert shown[BASELINE, "forward"] == (2.5, "s", "second call 0.5000 s")
    stopped = shown["a process, compiled by an earlier process", ""]
    assert stopped[0] == gpu_first.LONGEST and "stopped" in stopped[2]


def test_the_program_of_first_calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["--device", "cpu", "--layer", "c64", "--shrink", "30"]
    found = gpu_first.run_process(arguments, str(tmp_path))
    assert set(found) == {BASELINE, CONTINUOUS}
    for calls in found.values():
        assert set(calls) == {"forward", STEP}
        assert all(seconds > 0 for pair in calls.values() for seconds in pair)
    program = tmp_path / "program.py"
    monkeypatch.setattr(gpu_first, "PROGRAM", program)
    program.write_text("import os\nraise SystemExit('cache ' + os.environ['TRITON_CACHE_DIR'])")
    with pytest.raises(RuntimeError, match=f"program.py a: cache {tmp_path}"):
        gpu_first.run_process(["a"], str(tmp_path))
    program.write_text("import time\ntime.sleep(60)")
    assert gpu_first.run_process([], str(tmp_path), longest=0.2) == {}


def test_a_peer_that_memory_does_not_suffice_for_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def exhausted(*_: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    with monkeypatch.context() as patch:
        patch.setattr(peers.ReferenceConv2d, "forward", exhausted)
        found = measure("gpu_layers") + measure("gpu_memory")
    assert all(row.subject != peers.REFERENCE for row in found)
    for row in found:
        assert ("out of memory: surfconv_ops.reference" in row.note) == (row.subject == BASELINE)
    monkeypatch.setattr(SurfConv2d, "forward", exhausted)
    plan = tiny_plan("gpu_layers")
    lost: dict[str, str] = {}
    jobs = suites.device_suites(Processor())["gpu_layers"].jobs(plan)
    with run._bar(len(jobs)) as bar:
        assert run.measure(plan, "gpu_layers", jobs, bar, lost) == []
    assert len(lost) == len(jobs) and "gpu_layers c8 tf32 forward" in lost


def test_the_seconds_planned_are_what_is_promised() -> None:
    names = {"gate", *suites.DEVICE_SUITES}
    assert set(DEVICE_FULL_SECONDS) == set(DEVICE_QUICK_SECONDS) == names
    assert sum(DEVICE_FULL_SECONDS.values()) < 7 * 60
    assert sum(DEVICE_QUICK_SECONDS.values()) < 75
    plan = make_plan(True, (1,), ("gpu_net",), "cuda")
    assert plan.seconds == {"gate": 10.0, "gpu_net": 5.0} and plan.minimum == 5


def on_the_processor(monkeypatch: pytest.MonkeyPatch, *names: str) -> Processor:
    device = Processor()
    monkeypatch.setattr(devices, "missing", lambda: "")
    monkeypatch.setattr(devices, "Cuda", lambda: device)
    monkeypatch.setattr(run, "make_plan", lambda *_: tiny_plan(*names))
    return device


def test_a_run_writes_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    device = on_the_processor(monkeypatch, "gpu_layers", "gpu_memory")
    assert run.main(["--device", "cuda", "--out", str(tmp_path)]) == 0
    assert "Targets: " in capsys.readouterr().out
    data, found = report.read_rows(tmp_path / "results.json")
    assert device.timed == sum(row.samples for row in found if row.unit == "ms") > 0
    assert data["machine"]["gpu"] == "none, a double" and data["gate"]["passed"]
    text = (tmp_path / "results.md").read_text()
    assert "Target by target:" in text and "CUDA events" in text
    columns = "| layer | dtype | nn.Conv2d, ms | SurfConv2d continuous, x nn.Conv2d |"
    assert columns in text and "deform_conv2d, x SurfConv2d continuous" in text
    if not charts.missing():
        for name in ("gpu_layers.png", "gpu_memory.png"):
            assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
            assert f"]({name})" in text


def test_a_red_gate_reports_no_speed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    device = on_the_processor(monkeypatch, "gpu_layers")
    right = gate.surf_conv2d
    monkeypatch.setattr(gate, "surf_conv2d", lambda *a, **o: 1.02 * right(*a, **o))
    assert run.main(["--device", "cuda", "--out", str(tmp_path)]) == 1
    assert "no speed is reported" in capsys.readouterr().err
    assert json.loads((tmp_path / "results.json").read_text())["rows"] == []
    assert device.timed == 0 and not list(tmp_path.glob("*.png"))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_without_a_device_the_program_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run.main(["--device", "cuda", "--out", str(tmp_path)]) == 2
    assert "--device cuda: torch" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
def test_a_quick_run_on_a_real_device(tmp_path: Path) -> None:
    # A process of its own: what stands in for torchvision and for layers stays here.
    program = [sys.executable, str(ROOT / "benchmarks" / "run.py")]
    done = subprocess.run(
        [*program, "--device", "cuda", "--quick", "--out", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    data, found = report.read_rows(tmp_path / "results.json")
    assert data["gate"]["passed"]
    assert data["machine"]["gpu"] == torch.cuda.get_device_properties(0).name
    assert {row.suite for row in found} == set(suites.DEVICE_SUITES)
    plain = [row for row in found if row.suite == "gpu_memory" and row.subject == BASELINE]
    for row in plain:
        layer = REAL_LAYERS[row.case]
        width = 2 if row.dtype == "bfloat16" else 4
        assert row.value >= layer.pixels * layer.channels_out * width / 2**20
