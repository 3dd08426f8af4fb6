"""Nine small scenes, each with what has to happen in it, and its picture.

Every scene is written as a scene file beside its frames, so that `torchdlo simulate` and `torchdlo view` take it from
there. The exit code is 1 if something did not happen that has to.
"""

from __future__ import annotations

import io
import os
import sys
import time
from pathlib import Path
from typing import Any

from gallery_matter import net, net_claims, pour, pour_claims, sand, sand_claims
from gallery_parts import HUGE, Show
from gallery_ropes import (
    band,
    band_claims,
    chain,
    chain_claims,
    gripper,
    gripper_claims,
    knot,
    knot_claims,
    plug,
    plug_claims,
    pulley,
    pulley_claims,
    wire,
    wire_claims,
)
from options import Parser, save

EXAMPLES = """examples:
  python experiments/gallery.py --only knot,chain --out runs/gallery
  torchdlo view runs/gallery/knot
  python experiments/gallery.py --quick
"""
LARGEST = 60_000
"""Bytes of a picture."""

GALLERY: dict[str, Show] = {
    "knot": Show("An overhand knot is pulled tight", knot, knot_claims),
    "chain": Show("Two linked loops", chain, chain_claims, moments=(0.0, 0.1, 0.6)),
    "plug": Show("A plug on a cable, and a ball on a thread below it", plug, plug_claims, 10, (0.0, 0.28, 2.0)),
    "gripper": Show("A gripper lifts a rope from a table", gripper, gripper_claims, 10, (0.0, 0.7, 2.2)),
    "wire": Show("A wire that is bent over a post keeps its bend", wire, wire_claims, 10, (0.0, 0.6, 1.0)),
    "pulley": Show("Two weights on a rope over a pulley", pulley, pulley_claims),
    "band": Show("A rubber band is stretched round three posts", band, band_claims, moments=(0.0, 0.25, 0.7)),
    "sand": Show("Sand falls on a rope", sand, sand_claims, moments=(0.0, 0.12, 0.4)),
    "pour": Show("Water is poured on a floating ring", pour, pour_claims, moments=(0.0, 0.15, 0.5)),
    "net": Show("A net of ropes catches an elastic ball", net, net_claims, moments=(0.0, 0.08, 0.25)),
}


def jpeg(png: bytes) -> bytes:
    """Return a picture that is small enough for a repository."""
    from PIL import Image

    for quality in range(90, 20, -5):
        content = io.BytesIO()
        Image.open(io.BytesIO(png)).convert("RGB").save(content, "JPEG", quality=quality, optimize=True)
        if content.tell() <= LARGEST:
            break
    return content.getvalue()


def show(name: str, out: Path, *, quick: bool, draw: bool, video: bool) -> dict[str, Any]:
    """Run one scene, write its files, and return what was measured."""
    from torchdlo import scene_files
    from torchdlo.cli.progress import progress
    from torchdlo.files import write_atomically
    from torchdlo.scene_files.run import run, save_frames

    here, one = out / name, GALLERY[name]
    description = one.scene(quick)
    scene_files.save(description, here / "scene.json")
    begin = time.perf_counter()
    with progress() as callback:
        frames = run(scene_files.read(here / "scene.json"), frame_stride=one.frame_stride, callback=callback)
    seconds = time.perf_counter() - begin
    save_frames(frames, here / "frames.npz", description)
    claims = {} if frames.problem else one.claims(frames, description)
    wrong = [text for text, (value, low, high) in claims.items() if not low <= value <= high]
    if frames.problem:
        wrong.append(frames.problem)
    if draw:
        from torchdlo.report.render.picture import stills_png

        write_atomically(here / f"{name}.jpg", jpeg(stills_png(frames, one.moments)))
    if video:
        from torchdlo.report.render.video_writer import write_video

        with progress() as callback:
            write_video(frames, here / "motion.mp4", speed=min(1.0, frames.time[-1] / 3), callback=callback)
    print(f"{name}: {one.title}: {seconds:.0f} s", flush=True)
    for text, (value, low, high) in claims.items():
        mark = " " if low <= value <= high else "X"
        most = "" if high == HUGE else f" to {high:.4g}"
        print(f"  {mark} {text}: {value:.4g} (expected {low:.4g}{most or ' or more'})", flush=True)
    for text in wrong:
        print(f"  did not happen: {text}", file=sys.stderr)
    return {"name": name, "seconds": seconds, "claims": claims, "wrong": wrong}


def main() -> int:
    """Run the gallery."""
    parser = Parser("gallery.py", description=__doc__, epilog=EXAMPLES)
    parser.add_argument("--only", default="", help=f"names, separated by commas: {', '.join(GALLERY)}")
    parser.add_argument("--out", default="runs/gallery", help="folder for scene files, frames and pictures")
    parser.add_argument("--json", default="", help="file for what was measured")
    parser.flag("quick", "coarser scenes")
    parser.flag("smoke", "the first scene only, coarse and without a picture: does the script run?")
    parser.flag("pictures", "draw them, too; needs the extra view of the package")
    parser.flag("video", "and videos")
    args = parser.parse_args()
    names = [n for n in args.only.split(",") if n] or list(GALLERY)
    wrong = [n for n in names if n not in GALLERY]
    if wrong:
        parser.error(f"--only {args.only}: there is no {', '.join(wrong)}; known are {', '.join(GALLERY)}")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    names = ["chain"] if args.smoke else names
    draw = args.pictures and not args.smoke
    rows = [show(n, Path(args.out), quick=args.quick or args.smoke, draw=draw, video=args.video) for n in names]
    save(args.json, {"rows": rows})
    return int(any(row["wrong"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
