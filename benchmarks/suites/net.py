"""The paper's net, single-level against levels fused into its layers and against the pyramid."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
from torch import Tensor, nn

import cases
import targets
from candidates import BASELINE, CONTINUOUS, LEVELS, random_like, surf_options
from frames import Scene, make_scene, smooth_kinds
from net import PARAMETERS, GuidedPaperNet, PaperNet
from peers import PYRAMID
from plan import Limits, Plan
from rows import Key, Row, make_row
from suites.job import Job, Suite, work_of
from surfconv_ops import SurfConvPyramid
from timing import interleave, thread_count

FORWARD, STEP = "forward", "forward + backward"
WITH_DEPTH = f"{CONTINUOUS}, gradient of depth too"
#: nn.Conv2d's weight gradient for the net's 1x1 stride-2 shortcut with 4 channels corrupts the
#: heap in channels_last (torch 2.13 on CPU), so the net is run contiguous only.
LAYOUT = "contiguous"
#: About the multiplications of a forward pass of all nets together, for the budget alone.
WORK = 500_000_000


def jobs(plan: Plan) -> list[Job]:
    """Inference and a training step, at every thread count."""

    def job(direction: str, threads: int) -> Job:
        return Job(
            f"{direction}, {threads} thread{'s' if threads > 1 else ''}",
            work_of(WORK, direction, 1, threads),
            lambda limits: _measure(direction, threads, plan.shrink, limits),
        )

    counts = plan.threads[:1] if plan.quick else plan.threads
    return [job(direction, threads) for threads in counts for direction in (FORWARD, STEP)]


def make_nets(scene: Scene) -> dict[str, nn.Module]:
    """The nets by subject, all with the same weights."""

    def surf(mode: str) -> nn.Module:
        torch.manual_seed(1)
        return GuidedPaperNet(**surf_options(mode, scene))

    torch.manual_seed(1)
    plain = PaperNet()
    return {
        BASELINE: plain,
        LEVELS: surf(LEVELS),
        CONTINUOUS: surf(CONTINUOUS),
        PYRAMID: SurfConvPyramid(plain, scene.levels, scene.reference_depth),
    }


def make_call(
    net: nn.Module, image: Tensor, depth: Tensor | None, direction: str
) -> Callable[[], object]:
    """Inference, or a step to the gradients of all parameters and of depth where it wants one."""
    inputs = (image,) if depth is None else (image, depth)

    def infer() -> object:
        net.eval()
        with torch.no_grad():
            return net(*inputs)

    leaves = [*net.parameters(), *(each for each in inputs if each.requires_grad)]

    def step() -> object:
        net.train()
        output = net(*inputs)
        return torch.autograd.grad(output, leaves, gradient)

    if direction == FORWARD:
        return infer
    gradient = random_like(net(*inputs))
    return step


def _measure(direction: str, threads: int, shrink: int, limits: Limits) -> list[Row]:
    started = time.perf_counter()
    kind = smooth_kinds()[0]
    channels, height, width = cases.NET_INPUT
    height, width = height // shrink, width // shrink
    scene = make_scene(kind, 1, height, width)
    image = torch.randn(1, channels, height, width, generator=torch.Generator().manual_seed(2))
    with thread_count(threads):
        calls = {
            name: make_call(net, image, None if name == BASELINE else scene.depth, direction)
            for name, net in make_nets(scene).items()
        }
        if direction == STEP:
            wanted = scene.depth.clone().requires_grad_()
            calls[WITH_DEPTH] = make_call(make_nets(scene)[CONTINUOUS], image, wanted, direction)
        timings = interleave(calls, limits, started)
    case = f"1x{channels}x{height}x{width}, {PARAMETERS:,} parameters"
    return [
        make_row(
            Key(
                "net",
                "the paper's net",
                case,
                name,
                direction,
                LAYOUT,
                "" if name == BASELINE else kind,
                threads=threads,
            ),
            timing,
            baseline=(BASELINE, timings[BASELINE]),
            target=None if name in (BASELINE, PYRAMID) else targets.NET,
        )
        for name, timing in timings.items()
    ]


SUITE = Suite(
    "net",
    "The paper's net",
    "FCN-8s on ResNet-18 with basic blocks of widths 4 to 32 (the paper's smallest), on one frame: "
    "nn.Conv2d, SurfConv2d in every layer larger than 1x1, and the paper's own way, the plain net "
    "run once per depth level. Ratios against nn.Conv2d. forward + backward is a training step to "
    "the gradients of all parameters. In the paper's Table 1, on its GPU, the 4-level way took "
    f"{targets.PAPER_PYRAMID_RATIO:.1f} times as long as the single-level net. Contiguous.",
    jobs,
)
