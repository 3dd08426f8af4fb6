"""Commands of `torchdlo` about cameras and films; like all of them they import what is slow only when they run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchdlo.cli.ending import stopped
from torchdlo.cli.progress import deferred_interrupt, progress
from torchdlo.errors import InputError
from torchdlo.files import check_writable, write_atomically

if TYPE_CHECKING:
    import numpy as np

    from torchdlo.sysid.recordings.recording import Recording
    from torchdlo.vision.film import FilmLook
    from torchdlo.vision.segment import Ranges

__all__ = ["calibrate_camera", "film", "print_films", "segment"]


def calibrate_camera(
    video: Annotated[Path, typer.Argument(help="Film of a printed board, moved and tilted.", metavar="VIDEO")],
    board: Annotated[str, typer.Option(help="Squares along a row and along a column.", metavar="COLUMNSxROWS")] = "9x6",
    square: Annotated[float, typer.Option(min=1e-4, help="Side of a square in m.")] = 0.025,
    marker: Annotated[
        float | None, typer.Option(min=1e-4, help="Side of a marker in m: a ChArUco board; none: a checkerboard.")
    ] = None,
    dictionary: Annotated[str, typer.Option(help="Markers of a ChArUco board, as OpenCV calls them.")] = "DICT_4X4_50",
    name: Annotated[str, typer.Option(help="Name of the camera.")] = "a",
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", help="File to write; other cameras in it stay. A picture of the errors goes beside it."
        ),
    ] = Path("cameras.json"),
    print_board: Annotated[
        Path | None, typer.Option(help="Write the board as a PNG to print, and do nothing else.", metavar="PNG")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Calibrate a camera from a film of a printed board, and say how well it explains the film.

    The board in the first picture in which it is found gives the world: x along its rows, y up along its columns, z out
    of it. Lay it flat for a world with z up, and leave the camera where it is.

    [bold]Examples:[/bold]

    torchdlo calibrate-camera board.mp4 --board 9x6 --square 0.025 --out my_rope/cameras.json

    torchdlo calibrate-camera - --board 7x5 --square 0.03 --marker 0.022 --print-board board.png
    """
    import dataclasses

    from torchdlo.vision import calibrate_camera as calibration
    from torchdlo.vision.camera import check_name, load_cameras, save_cameras, states_rate

    check_name(name, "--name")
    printed = calibration.Board(*_board(board), square, marker, dictionary)
    if print_board is not None:
        import cv2

        if print_board.suffix.lower() != ".png":
            raise InputError(f"--print-board: expected a name that ends in .png, found {print_board}.")
        check_writable(print_board, mark=b"PNG")
        done, data = cv2.imencode(".png", calibration.board_picture(printed))
        write_atomically(print_board, data.tobytes() if done else b"")
        typer.echo(
            f"board: {print_board}; print it so that a square is {1e3 * square:g} mm, and glue it to a flat plate"
        )
        return
    picture = out.with_name(f"{out.stem}_{name}.png")
    known = load_cameras(out) if out.exists() else ()
    others = [c for c in known if c.name != name]
    if not out.exists():
        check_writable(out)
    check_writable(picture)
    try:
        with progress() as show, deferred_interrupt(show) as callback:
            found = calibration.calibrate_camera(video, printed, name=name, callback=callback)
    except KeyboardInterrupt:
        raise stopped("there was no result yet, and nothing was written") from None
    # A board tells nothing of the clock: what a person has written down of it stays.
    before = next((c for c in known if c.name == name), found.camera)
    camera = dataclasses.replace(found.camera, start=before.start, starts=before.starts)
    unknown = {c.name for c in others} - (states_rate(out) if out.exists() else set())
    save_cameras([*others, camera], out, unknown_rate=unknown)
    write_atomically(picture, calibration.error_picture(found))
    typer.echo(
        f"camera {name}: focal length {camera.fx:.1f} x {camera.fy:.1f} px, reprojection error {found.error:.3f} px in "
        f"{len(found.pictures)} pictures; the world is the board in picture {found.pictures[0]}",
        err=as_json,
    )
    notes = [*found.notes, *([f"start = {camera.start:g} s is kept as {out} had it."] if camera.start else [])]
    notes += [f"starts of {len(camera.starts)} trials are kept as {out} had them."] if camera.starts else []
    for note in notes:
        typer.echo(f"note: {note}", err=as_json)
    typer.echo(f"cameras: {out}\npicture: {picture}", err=as_json)
    if as_json:
        content = {"camera": dataclasses.asdict(camera), "error_px": found.error, "pictures": list(found.pictures)}
        typer.echo(json.dumps(content | {"notes": notes}, indent=1))


def _board(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(p.isdigit() and 3 <= int(p) <= 50 for p in parts):
        raise InputError(f"--board: expected squares as COLUMNSxROWS, for instance 9x6, found {text!r}.")
    return int(parts[0]), int(parts[1])


def segment(
    video: Annotated[Path, typer.Argument(help="Film of a rope, or a folder of PNG files.", metavar="VIDEO")],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Ranges of colour to write: segment.json of a recording folder.")
    ] = Path("segment.json"),
    color: Annotated[
        str | None, typer.Option(help="Colour of the rope, instead of the page to set it.", metavar="R,G,B")
    ] = None,
    ranges: Annotated[Path | None, typer.Option(help="Ranges that were saved before.", metavar="FILE")] = None,
    background: Annotated[
        Path | None,
        typer.Option(
            help="Picture of the same view without the rope: take what differs. Of --ranges it takes close, smallest "
            "and ignore.",
            metavar="PNG",
        ),
    ] = None,
    least: Annotated[float, typer.Option(min=1, max=255, help="Smallest difference from it, of 255.")] = 40,
    masks: Annotated[Path | None, typer.Option(help="Write masks, too, and say what is wrong with them.")] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0 takes a free one.")] = 0,
) -> None:
    """Set which colours belong to the rope, in a page of this machine alone, or make masks.

    [bold]Examples:[/bold]

    torchdlo segment my_rope/train_0.a.mp4 --out my_rope/segment.json

    torchdlo segment my_rope/train_0.a.mp4 --color 25,150,60 --masks masks.npz
    """
    from torchdlo.vision import segment as work

    check_writable(out)
    if masks is not None:
        if masks.suffix != ".npz":
            raise InputError(f"--masks: expected a name that ends in .npz, found {masks}.")
        check_writable(masks)
    pictures, _ = work.load_film(video)
    if pictures.dtype == bool:
        what = "masks; they are used as they are" if pictures.any() else "black pictures only; film it again"
        raise InputError(f"{video}: expected a film in colour, found {what}.")
    chosen = work.load_ranges(ranges) if ranges is not None else work.ranges_of(_rgb(color)) if color else None
    served = background is None and chosen is None
    found: np.ndarray | None = None
    if background is not None:
        if color is not None:
            raise InputError("expected --color or --background, found both; --ranges says what else is left out.")
        empty = _background(background, pictures.shape[1:3])
        found = work.background_masks(pictures, empty, least, chosen or work.Ranges())
    else:
        if served or chosen is None:
            _serve(pictures, out, port)
            if not out.exists():
                raise stopped("nothing was saved")
            chosen = work.load_ranges(out)
        if masks is not None:
            found = work.color_masks(pictures, chosen)
    said = [] if found is None else _healthy(found, str(video), pictures)
    if background is None and chosen is not None:
        if not served:
            work.save_ranges(chosen, out)
        typer.echo(f"ranges: {out}")
    typer.echo("\n".join(said), nl=bool(said))
    if masks is not None and found is not None:
        work.save_masks(found, masks)
        typer.echo(f"masks:  {masks}")


def _healthy(masks: Any, where: str, pictures: Any) -> list[str]:
    """Return what is wrong with masks, and how many can be used; refuse those that say nothing."""
    from torchdlo.vision.mask_health import check_masks

    good, issues = check_masks(masks, where, pictures=pictures)
    return [*(f"masks: {issue.text}" for issue in issues), f"{int(good.sum())} of {len(good)} frames can be used"]


def _rgb(text: str) -> list[float]:
    parts = text.split(",")
    if len(parts) != 3 or not all(p.strip().isdigit() and int(p) <= 255 for p in parts):
        raise InputError(f"--color: expected R,G,B from 0 to 255, found {text!r}.")
    return [float(p) for p in parts]


def _background(path: Path, size: tuple[int, int]) -> Any:
    from torchdlo.vision.segment import read_picture

    picture = read_picture(path)
    if picture.shape[:2] != size:
        found = f"{picture.shape[1]} x {picture.shape[0]}"
        raise InputError(f"{path}: expected {size[1]} x {size[0]} pixels as the film has, found {found}.")
    return picture


def _serve(pictures: Any, out: Path, port: int) -> None:
    from torchdlo.vision.segment import Ranges, load_ranges
    from torchdlo.vision.segment_server import segment_server

    first: Ranges = load_ranges(out) if out.exists() else Ranges()
    server = segment_server(pictures[:: max(1, len(pictures) // 200)], first, out, port=port)
    typer.echo(f"open {server.address}, save there, and end with Ctrl-C")
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        pass
    finally:
        server.server_close()


def film(
    source: Annotated[
        Path, typer.Argument(help="Recording folder with markers, or a run of simulate.", metavar="PATH")
    ],
    cameras: Annotated[Path, typer.Argument(help="Cameras that film, as calibrate-camera writes them.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="New folder for the films.", metavar="DIR")],
    masks: Annotated[bool, typer.Option("--masks", help="Write masks in the place of pictures.")] = False,
    color: Annotated[str, typer.Option(help="Colour of the rope.", metavar="R,G,B")] = "25,150,60",
    radius: Annotated[float | None, typer.Option(min=1e-5, help="Radius of the rope in m, if not known.")] = None,
    noise: Annotated[float, typer.Option(min=0, help="Standard deviation of a channel's noise, of 255.")] = 3.0,
    blur: Annotated[float, typer.Option(min=0, help="Blur of the lens in pixels.")] = 0.6,
    exposure: Annotated[float, typer.Option(min=0, help="Exposure in s.")] = 4e-3,
    bar: Annotated[
        str | None, typer.Option(help="Left, top, right, bottom of a bar in front, as shares.", metavar="L,T,R,B")
    ] = None,
    wrong: Annotated[float, typer.Option(min=0, max=0.3, help="Share of frames that are wrong.")] = 0.0,
    off: Annotated[
        float,
        typer.Option(
            min=0,
            max=5,
            help="Of recordings: how far the cameras that are written down are off those that filmed: 1 stands for up "
            "to 1 degree, 1 %, 10 mm and half a frame.",
        ),
    ] = 0.0,
    begun_off: Annotated[
        float, typer.Option(min=0, max=2, help="Of recordings: each film begins up to so many frames early or late.")
    ] = 0.0,
    trials: Annotated[int | None, typer.Option(min=1, help="Of recordings: most trials of each split.")] = None,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="Of recordings: most seconds of each trial.")] = None,
    quality: Annotated[int, typer.Option(min=0, max=51, help="Of H.264: 0 is lossless, 51 the smallest file.")] = 18,
    seed: Annotated[int, typer.Option(min=0, help="Of noise and faults.")] = 0,
) -> None:
    """Film a recording or a run through given cameras, by a rasteriser of its own: test data for what reads films.

    Of a recording, the result is a recording folder whose trials have grippers and films, no markers.

    [bold]Examples:[/bold]

    torchdlo film my_rope cameras.json --out filmed_rope --noise 4 --wrong 0.02 --off 1

    torchdlo film runs/lift cameras.json --out films --masks
    """
    from torchdlo.sysid.recordings.recording import check_new_folder
    from torchdlo.sysid.video.filming import film_recording, film_run
    from torchdlo.vision.camera import load_cameras

    shown = load_cameras(cameras)
    check_new_folder(out)
    look = _look(color, noise, blur, exposure, bar, wrong, seed)
    try:
        with progress() as show, deferred_interrupt(show) as callback:
            options: dict[str, Any]
            if (source / "rope.json").is_file():
                from torchdlo.sysid.recordings.recording import load_recording

                options = {"masks": masks, "off": off, "begun_off": begun_off, "trials": trials, "seconds": seconds}
                options |= {"quality": quality}
                said = film_recording(
                    load_recording(source), shown, out, look, radius=radius, **options, callback=callback
                )
            else:
                from torchdlo.scene_files.run import load_frames

                given = {"--off": off > 0, "--begun-off": begun_off > 0}
                given |= {"--trials": trials is not None, "--seconds": seconds is not None}
                if any(given.values()):
                    names = " and ".join(n for n, there in given.items() if there)
                    raise InputError(f"{source}: expected {names} for a recording only, found a run.")
                frames = load_frames(source)
                width = float(frames.radius[0]) if radius is None else radius
                ropes = (frames.time, frames.pos, frames.rope, width)
                options = {"masks": masks, "quality": quality, "closed": bool(frames.closed[0])}
                said = film_run(*ropes, shown, out, look, **options, callback=callback)
    except KeyboardInterrupt:
        raise stopped("nothing was written") from None
    for sentence in said:
        typer.echo(sentence)


def _look(color: str, noise: float, blur: float, exposure: float, bar: str | None, wrong: float, seed: int) -> FilmLook:
    from torchdlo.vision.film import FilmLook

    red, green, blue = (int(c) for c in _rgb(color))
    place = None
    if bar is not None:
        try:
            left, top, right, bottom = (float(p) for p in bar.split(","))
        except ValueError:
            raise InputError(f"--bar: expected left,top,right,bottom as shares from 0 to 1, found {bar!r}.") from None
        if not (0 <= left < right <= 1 and 0 <= top < bottom <= 1):
            raise InputError(f"--bar: expected 0 <= left < right <= 1 and 0 <= top < bottom <= 1, found {bar!r}.")
        place = (left, top, right, bottom)
    return FilmLook((red, green, blue), noise=noise, blur=blur, exposure=exposure, bar=place, wrong=wrong, seed=seed)


def print_films(recording: Recording) -> None:
    """Say which pictures of a recording can be used."""
    from torchdlo.sysid.video.footage import views_of

    for split, trials in (("train", recording.train), ("test", recording.test)):
        with progress() as callback:
            views, notes = views_of(recording, trials, callback)
        for view in views:
            usable = f"{int(view.good.sum())} pictures of {len(trials)} trials can be used"
            wide = f"the rope is {2 * view.half_width:.1f} px wide"
            typer.echo(f"{split}, camera {view.camera.name}: {usable}, {wide}")
        for note in notes:
            typer.echo(note)
