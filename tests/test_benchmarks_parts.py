"""What the benchmark programs compute: the net, the peers, the gate's own relation, the depth."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import nn
from torch.nn.functional import conv2d

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import allocator
import candidates
import cases
import frames
import gate
import instructions
import net
import peers
import points
from surfconv_ops import SurfConv2d
from voxels import voxelise


def test_the_converted_net_is_the_papers_at_reference_depth() -> None:
    torch.manual_seed(0)
    plain = net.PaperNet().double().eval()
    torch.manual_seed(0)
    surf = net.GuidedPaperNet(reference_depth=4.0).double().eval()
    for module in surf.modules():
        if isinstance(module, nn.Conv2d):
            assert isinstance(module, SurfConv2d) == (module.kernel_size != (1, 1))
    image = torch.randn(1, 6, 48, 64, dtype=torch.float64)
    expected = plain(image)
    at_reference = surf(image, torch.full((1, 48, 64), 4.0))
    torch.testing.assert_close(at_reference, expected, rtol=1e-10, atol=1e-10)
    elsewhere = surf(image, torch.full((1, 48, 64), 2.0))
    assert (elsewhere - expected).abs().max() > 1e-3


@pytest.mark.parametrize("peer", [peers.GridSampleConv2d, peers.ReferenceConv2d])
@pytest.mark.parametrize("layer", ["A", "stem"])
def test_peers_compute_what_surf_conv2d_computes(peer: type[peers.DepthConv2d], layer: str) -> None:
    shape = {**cases.MAIN, **cases.NET_LAYERS}[layer].shrunk(10)
    assert_peer_agrees(peer, shape)


@pytest.mark.skipif(bool(peers.unavailable()), reason="torchvision cannot be used here")
@pytest.mark.parametrize("layer", ["A", "stem"])
def test_deform_conv2d_computes_what_surf_conv2d_computes(layer: str) -> None:
    shape = {**cases.MAIN, **cases.NET_LAYERS}[layer].shrunk(10)
    assert_peer_agrees(peers.DeformConv2d, shape)


def assert_peer_agrees(peer: type[peers.DepthConv2d], shape: cases.Layer) -> None:
    scene = candidates.scene_of(shape, frames.make_scene, frames.RANDOM)
    ours = candidates.make_candidate(candidates.CONTINUOUS, shape, "contiguous", scene)
    module = candidates.make_conv(shape, peer, reference_depth=scene.reference_depth)
    theirs = candidates.Candidate(module, ours.input.clone(), scene.depth.clone())
    assert gate.relative_rms(theirs.forward(), ours.forward()) < 1e-4
    pairs = zip(theirs.backward()(), ours.backward()(), strict=True)
    for name, (got, want) in zip(("input", "weight", "bias"), pairs, strict=False):
        assert gate.relative_rms(got, want) < 1e-3, name


def test_the_gates_relation_is_conv2d_at_scale_one_and_nothing_else() -> None:
    for shape in (cases.NET_LAYERS["stem"], cases.GROUPED["grouped"]):
        layer = shape.shrunk(8)
        conv = candidates.make_conv(layer).double()
        image = candidates.make_input(layer, "contiguous").double()
        scale = torch.ones(layer.batch, *layer.output_size, dtype=torch.float64)
        chosen = points.choose_points(layer)
        arguments = (layer, chosen, image, conv.weight, conv.bias)
        n, y, x = chosen.unbind(1)
        expected = conv2d(
            image, conv.weight, conv.bias, layer.stride, layer.padding, groups=layer.groups
        )[n, :, y, x]
        exact = points.at_points(*arguments, scale, None, 0.0)
        torch.testing.assert_close(exact, expected, rtol=1e-12, atol=1e-12)
        wider = points.at_points(*arguments, 1.5 * scale, None, 0.0)
        assert gate.relative_rms(wider, expected) > 0.1


def test_depth_of_every_kind_is_usable(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in (*frames.smooth_kinds(), frames.RANDOM):
        scene = frames.make_scene(kind, 2, 24, 32)
        valid = scene.depth > 0
        assert scene.depth.shape == (2, 24, 32) and valid.float().mean() > 0.5
        counts = torch.bincount(scene.levels.assign(scene.depth)[valid])
        assert len(counts) == 4 and counts.min() > 0.15 * counts.sum()
    scale = frames.REFERENCE_DEPTH / frames.make_scene(frames.RANDOM, 1, 64, 64).depth
    assert math.isclose(float(scale.min()), 0.3, rel_tol=0.02)
    assert math.isclose(float(scale.max()), 6.0, rel_tol=0.02)
    monkeypatch.delenv(frames.VARIABLE, raising=False)
    frames._real_frames.cache_clear()
    try:
        assert frames.smooth_kinds() == (frames.SYNTHETIC,)
        assert "synthetic" in frames.source()
        assert 0 < (frames.make_scene(frames.SYNTHETIC, 1, 60, 80).depth == 0).sum() < 240
    finally:
        frames._real_frames.cache_clear()


def test_voxels_hold_the_mean_of_their_points() -> None:
    features = torch.tensor([[[1.0, 3.0, 5.0]]])
    depth = torch.tensor([[1.0, 1.0, 0.0]])
    grid = voxelise(features, depth, 1.0, (2, 2, 4), 1.0)
    # Columns lie at x = -1, 0 and 1: the first two fall into voxels 0 and 1; the last has no depth.
    assert grid.shape == (1, 1, 2, 2, 4)
    assert grid[0, 0, :, 1, 1].tolist() == [1.0, 3.0]
    assert grid.sum() == 4.0
    merged = voxelise(features, depth, 1.0, (1, 1, 1), 10.0)
    assert merged.flatten().tolist() == [2.0]


def test_freed_blocks_are_kept() -> None:
    """In a process of its own: the setting stays.

    The allocator's caches of small chunks hold the slack between aligned blocks, so that the
    first blocks, a dozen at most, may not fit where the one before them was; then these are full.
    """
    code = """
import resource, torch, allocator
torch.set_num_threads(1)
print(allocator.keep_freed_blocks())
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    torch.ones(12 << 20)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
first = faults()
print(first, sorted(faults() for _ in range(101))[50])
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=Path(allocator.__file__).parent,
                          check=True, timeout=120, capture_output=True, text=True)  # fmt: skip
    kind, counts = done.stdout.splitlines()
    if kind != "glibc, freed blocks are kept":
        pytest.skip(f"allocator: {kind}")
    first, usual = map(int, counts.split())
    assert usual < first / 10


def test_a_run_is_held_to_an_instruction_set() -> None:
    code = """
import torch, surfconv_ops, instructions
print(torch.backends.cpu.get_cpu_capability(), torch.ops.surfconv.cpu_capability(),
      instructions.held_to())
"""
    folder = Path(instructions.__file__).parent
    held = instructions.environment("avx2")
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, env=held, check=True,
                          timeout=120, capture_output=True, text=True)  # fmt: skip
    if "AVX2" not in torch.backends.cpu.get_cpu_capability().replace("AVX512", "AVX2"):
        pytest.skip("a processor without AVX2")
    assert done.stdout.split() == ["AVX2", "avx2", "avx2"]


def test_the_same_command_starts_again() -> None:
    """With its own arguments, held to what was asked for."""
    code = """
import sys, instructions
if instructions.held_to() == "nothing":
    raise SystemExit(instructions.start_again("avx2"))
print(sys.argv[1:])
raise SystemExit(3)
"""
    folder = Path(instructions.__file__).parent
    plain = {k: v for k, v in os.environ.items() if k not in instructions.VARIABLES["avx2"]}
    done = subprocess.run([sys.executable, "-c", code, "--quick", "a b"], cwd=folder, env=plain,
                          timeout=120, capture_output=True, text=True)  # fmt: skip
    assert (done.returncode, done.stdout) == (3, "['--quick', 'a b']\n")
