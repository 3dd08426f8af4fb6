"""Time and accuracy of the rasteriser: `python experiments/bench_raster.py [--quick]`; prints one JSON object.

CPU seconds of 100 masks of a rope of 60 edges, forward and backward, on one thread, minimum of repeats; error of
gradients against central differences; area against a picture 16 times as fine; gradient through physics.
"""

from __future__ import annotations

import argparse
import json
import time

import torch

from torchdlo.vision.rasterizer import coverage, coverage_reference, successors


def ropes(count: int, vertices: int, height: int, width: int, dtype: torch.dtype) -> torch.Tensor:
    """Curves across the picture, some of which cross themselves, shape (count, vertices, 2) [px]."""
    generator = torch.Generator().manual_seed(0)
    s = torch.linspace(0, 1, vertices, dtype=dtype)
    a = torch.rand(count, 5, 1, generator=generator, dtype=dtype)
    x = width * (0.15 + 0.7 * s + 0.1 * torch.sin(6 * s * (1 + a[:, 0]) + 6 * a[:, 1]))
    y = height * (0.5 + 0.3 * a[:, 3] * torch.sin(5 * s + 6 * a[:, 2]) + 0.15 * torch.sin(9 * s + 6 * a[:, 4]))
    return torch.stack([x, y], -1)


def timed(height: int, width: int, dtype: torch.dtype, repeats: int, draw=coverage) -> dict[str, float]:
    """CPU seconds of 100 masks forward and backward."""
    pixel, radius = ropes(100, 61, height, width, dtype), torch.full((100, 61), 4.0, dtype=dtype)
    real, after, best = torch.ones(100, 61, dtype=torch.bool), successors([61]), (float("inf"), 0.0, 0.0)
    for _ in range(repeats):
        own = pixel.clone().requires_grad_()
        begun = time.process_time()
        out = draw(own, radius, real, after, (height, width))
        middle = time.process_time()
        weight = torch.ones_like(out)
        later = time.process_time()
        out.backward(weight)
        forward, backward = middle - begun, time.process_time() - later
        best = min(best, (forward + backward, forward, backward))
    return dict(zip(("total_s", "forward_s", "backward_s"), best, strict=True))


def gradient_error(height: int = 96, width: int = 128) -> float:
    """Largest error of the gradient against central differences, over its largest entry."""
    pixel, radius = ropes(4, 61, height, width, torch.float64), torch.full((4, 61), 3.0, dtype=torch.float64)
    real, after = torch.ones(4, 61, dtype=torch.bool), successors([61])
    weight = torch.randn(4, height, width, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def loss(p: torch.Tensor) -> torch.Tensor:
        return (coverage(p, radius, real, after, (height, width)) * weight).sum()

    own = pixel.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(own), own)
    worst, step = 0.0, 1e-6
    for place in range(0, pixel.numel(), 7):
        moved = [pixel.clone().reshape(-1) for _ in range(2)]
        moved[0][place] += step
        moved[1][place] -= step
        difference = (loss(moved[0].reshape(pixel.shape)) - loss(moved[1].reshape(pixel.shape))) / (2 * step)
        worst = max(worst, abs(float(difference - gradient.reshape(-1)[place])))
    return worst / float(gradient.abs().max())


def area_error(height: int, width: int, radius: float) -> float:
    """Largest error of area against a picture 16 times as fine, as a share."""
    pixel, wide = ropes(3, 61, height, width, torch.float64), torch.full((3, 61), radius, dtype=torch.float64)
    args = torch.ones(3, 61, dtype=torch.bool), successors([61])
    coarse = coverage(pixel, wide, *args, (height, width)).sum((1, 2))
    fine = coverage((pixel + 0.5) * 16 - 0.5, 16 * wide, *args, (16 * height, 16 * width)).round().sum((1, 2)) / 256
    return float((coarse / fine - 1).abs().max())


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer repeats, no reference")
    quick = parser.parse_args().quick
    torch.set_num_threads(1)
    repeats, found = 2 if quick else 7, {}
    for height, width in ((256, 256), (480, 640)):
        for dtype in (torch.float32, torch.float64):
            found[f"{width}x{height}_{str(dtype).removeprefix('torch.')}"] = timed(height, width, dtype, repeats)
    if not quick:
        reference = timed(64, 64, torch.float32, 1, coverage_reference)
        found["64x64_float32_reference"] = reference
    found["gradient_error"] = gradient_error()
    found["area_error"] = {f"radius {r} px": area_error(120, 160, r) for r in (0.5, 1.0, 3.0)}
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
