"""What `renderer.cpp` does, in array operations: the judge of its tests, and hundreds of times slower in its place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchdlo.vision.shading_reference import background_light, dot, encoded, surface_colors, surface_light, unit

__all__ = ["draw", "tube"]

NEAR, FAR, EDGE, BLOCK = np.float32(0.01), np.float32(-1e30), np.float32(-1e-6), 12
_X = (-0.33, -0.84, -0.70, -0.20, 0.96, 0.47, 0.52, 0.19, 0.51, 0.90, -0.32, -0.05)
_Y = (-0.41, -0.07, 0.46, 0.62, -0.19, -0.48, 0.77, -0.89, 0.06, 0.41, -0.93, 0.15)
AROUND = np.stack([np.array(_X, np.float32), np.array(_Y, np.float32)], -1)
"""Places in a disc at which the map of shadows is looked at."""

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class _Mesh:
    """What is drawn of a scene, in the world."""

    pos: Array
    normal: Array
    uv: Array
    face: Array
    owner: Array
    """Piece of each triangle; ropes come after the pieces."""
    casts: Array
    """Whether each triangle casts a shadow."""


def draw(given: dict[str, Array], settings: dict[str, int], out: dict[str, Array | None]) -> None:
    """Fill the pictures that are asked for; arguments as `renderer.renderer_inputs` makes them."""
    batch, cameras = given["camera"].shape[:2]
    for b in range(batch):
        scene = {k: v[b] if k in _MOVING else v for k, v in given.items()}
        shadow = None
        if out["rgb"] is not None and settings["shadow"]:
            shadow = _shadow(scene, _mesh(scene, settings["shadow"] / 4), settings["shadow"])
        for c in range(cameras):
            camera = _Camera(scene["camera"][c])
            pixels = _pixels_per_metre(scene, camera) if settings["detail"] else 0.0
            images = {k: None if v is None else v[b, c] for k, v in out.items()}
            _picture(scene, _mesh(scene, pixels), camera, shadow, settings, images)


_MOVING = {
    "piece_pose",
    "rope_pos",
    "particle_pos",
    "camera",
    "piece_material",
    "rope_material",
    "group_material",
    "light",
}


class _Camera:
    def __init__(self, numbers: Array) -> None:
        self.focal, self.middle = numbers[:2], numbers[2:4]
        self.turn, self.shift = numbers[4:13].reshape(3, 3), numbers[13:]
        self.eye = -self.turn.T @ self.shift

    def local(self, p: Array) -> Array:
        return p @ self.turn.T + self.shift


def _pixels_per_metre(scene: dict[str, Array], camera: _Camera) -> float:
    z = camera.local(scene["rope_pos"])[:, 2] if len(scene["rope_pos"]) else np.zeros(0)
    z = z[z > 0.02]
    return float(camera.focal.max() / z.min()) if len(z) else float(camera.focal.max() / 1e30)


def _mesh(scene: dict[str, Array], pixels: float) -> _Mesh:
    """Return all pieces where they are, and tubes about all ropes."""
    pieces = len(scene["piece_id"])
    own = np.repeat(np.arange(pieces), np.diff(scene["piece_vertex"]))
    turn, shift = scene["piece_pose"][:, :9].reshape(-1, 3, 3), scene["piece_pose"][:, 9:]
    pos = [np.einsum("nij,nj->ni", turn[own], scene["vertex"]) + shift[own]]
    normal = [np.einsum("nij,nj->ni", turn[own], scene["normal"])]
    owner = [np.repeat(np.arange(pieces), np.diff(scene["piece_face"]))]
    casts = [scene["piece_flags"][owner[0]] > 0]
    uv, face, start = [np.zeros((len(pos[0]), 2), np.float32)], [scene["face"].reshape(-1, 3)], len(pos[0])
    for rope, closed in enumerate(scene["rope_closed"]):
        at = slice(scene["rope_start"][rope], scene["rope_start"][rope + 1])
        x, radius = scene["rope_pos"][at], scene["rope_radius"][at]
        if len(x) < 2:
            continue
        edge = np.linalg.norm(np.diff(x, axis=0), axis=1).max()
        sides, parts = 16, 3
        if pixels > 0:
            thick, long = radius.max() * pixels, edge * pixels
            sides = 6 if thick < 2 else 8 if thick < 5 else 12 if thick < 14 else 16
            parts = 1 if long < 4 else 2 if long < 12 else 3 if long < 40 else 4
        found = tube(x, radius, bool(closed), sides, parts)
        for kept, made in zip((pos, normal, uv, face), (*found[:3], found[3] + start), strict=True):
            kept.append(made)
        owner.append(np.full(len(found[3]), pieces + rope))
        casts.append(np.ones(len(found[3]), bool))
        start += len(found[0])
    places, normals, texels = (np.concatenate(x).astype(np.float32) for x in (pos, normal, uv))
    faces, owners, shadows = (np.concatenate(x) for x in (face, owner, casts))
    return _Mesh(places, normals, texels, faces.astype(int), owners, shadows)


def tube(x: Array, radius: Array, closed: bool, sides: int, parts: int) -> tuple[Array, Array, Array, Array]:
    """Return a tube about a smooth curve: corners [m] and normals (N, 3), places (N, 2), triangles (T, 3).

    A place is how far round the tube a corner is, 0 to 1, and how far along the curve [m].

    Args:
        x: vertices of the curve [m], shape (V, 3).
        radius: of the tube there [m], shape (V,).
        closed: whether it is a loop.
        sides: corners round it.
        parts: rings for each edge.
    """
    count = len(x)
    edges = count if closed else count - 1
    if closed:
        padded, wide = np.concatenate([x[-1:], x, x[:2]]), np.concatenate([radius, radius[:1]])
    else:
        padded, wide = np.concatenate([2 * x[:1] - x[1:2], x, 2 * x[-1:] - x[-2:-1]]), radius
    a, b, c, d = (padded[k : k + edges, None] for k in range(4))
    t = (np.arange(parts, dtype=np.float32) / parts)[:, None]
    curve = 0.5 * (2 * b + t * (c - a) + t**2 * (2 * a - 5 * b + 4 * c - d) + t**3 * (3 * b - a - 3 * c + d))
    middle = np.concatenate([curve.reshape(-1, 3), padded[edges + 1 : edges + 2]])
    r = np.concatenate(
        [(wide[:edges, None] + t[:, 0] * np.diff(wide)[:edges, None]).reshape(-1), wide[edges : edges + 1]]
    )
    before, after = np.concatenate([middle[:1], middle[:-1]]), np.concatenate([middle[1:], middle[-1:]])
    if closed:
        before[0], after[-1] = middle[-2], middle[1]
    ahead = unit(after - before)
    other = np.array([1, 0, 0] if abs(ahead[0, 0]) < 0.6 else [0, 1, 0], np.float32)
    side, v = np.empty_like(middle), other
    for k, tangent in enumerate(ahead):
        side[k] = v = unit(v - dot(v, tangent) * tangent)
    along = np.concatenate([[0], np.linalg.norm(np.diff(middle, axis=0), axis=1).cumsum()])
    gradient = np.zeros(len(middle))
    if not closed:
        height, width = np.array([0.9999, 0.8660254, 0.5]), np.array([0.0141, 0.5, 0.8660254])
        caps = [middle[e] - s * height[:, None] * r[e] * ahead[e] for e, s in ((0, 1), (-1, -1))]
        middle = np.concatenate([caps[0], middle, caps[1][::-1]])
        r = np.concatenate([width * r[0], r, (width * r[-1])[::-1]])
        gradient = np.concatenate([-height / width, gradient, (height / width)[::-1]])
        ahead, side, along = (
            np.concatenate([y[:1].repeat(3, 0), y, y[-1:].repeat(3, 0)]) for y in (ahead, side, along)
        )
    angle = 2 * np.pi * np.arange(sides + 1) / sides
    third = np.cross(ahead, side)
    away = np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * third[:, None]
    pos = middle[:, None] + r[:, None, None] * away
    normal = unit(away + gradient[:, None, None] * ahead[:, None])
    uv = np.stack(np.broadcast_arrays(np.arange(sides + 1) / sides, along[:, None]), -1)
    i, j = np.meshgrid(np.arange(len(middle) - 1), np.arange(sides), indexing="ij")
    p, q = i * (sides + 1) + j, (i + 1) * (sides + 1) + j
    face = np.stack([np.stack([p, p + 1, q], -1), np.stack([p + 1, q + 1, q], -1)], -2)
    return pos.reshape(-1, 3), normal.reshape(-1, 3), uv.reshape(-1, 2), face.reshape(-1, 3)


def _draw(corners: Array, number: int, both: bool, near: Array, numbers: Array | None) -> None:
    """Draw one triangle, corners (x, y, w) with w linear in the buffer and larger where it is nearer, shape (3, 3)."""
    a, b, c = corners.astype(np.float32)
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    if not (area != 0 if both else area < 0):
        return
    height, width = near.shape
    low, high = np.maximum(corners.min(0)[:2], 0), np.minimum(corners.max(0)[:2], [width - 1, height - 1])
    if not (low <= high).all():
        return
    (x0, y0), (x1, y1) = np.ceil(low).astype(int), np.floor(high).astype(int)
    if x0 > x1 or y0 > y1:
        return
    # Triangles may reach far beyond the picture: rows start in double precision.
    a, b, c = corners.astype(np.float32).astype(float)
    over = 1 / ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
    ux, uy, vx, vy = over * (c[1] - a[1]), -over * (c[0] - a[0]), -over * (b[1] - a[1]), over * (b[0] - a[0])
    x, dx = np.arange(x1 - x0 + 1, dtype=np.float32), x0 - a[0]
    dy = np.arange(y0, y1 + 1)[:, None] - a[1]
    u0, v0, wu, wv = uy * dy + ux * dx, vy * dy + vx * dx, b[2] - a[2], c[2] - a[2]
    starts = (u0, v0, a[2] + wu * u0 + wv * v0)
    u, v, w = (np.float32(n) + np.float32(k) * x for n, k in zip(starts, (ux, vx, wu * ux + wv * vx), strict=True))
    part = (slice(y0, y1 + 1), slice(x0, x1 + 1))
    hit = (u >= EDGE) & (v >= EDGE) & (1 - u - v >= EDGE) & (w > near[part])
    near[part] = np.where(hit, w, near[part])
    if numbers is not None:
        numbers[part] = np.where(hit, number, numbers[part])


class _Shadow:
    def __init__(self, near: Array, axes: Array, low: Array, scale: float, far: float, deep: float) -> None:
        self.near, self.axes, self.low, self.scale, self.far, self.deep = near, axes, low, scale, far, deep

    def corner(self, p: Array) -> Array:
        q = p @ self.axes.T
        flat = (q[..., :2] - self.low) * self.scale - 0.5
        return np.concatenate([flat, (self.far - q[..., 2:]) / self.deep], -1).astype(np.float32)

    def _at(self, x: Array, y: Array) -> Array:
        size = len(self.near)
        inside = (x >= 0) & (y >= 0) & (x < size) & (y < size)
        return np.where(inside, self.near[np.clip(y, 0, size - 1), np.clip(x, 0, size - 1)], FAR)

    def _filtered(self, x: Array, y: Array, own: Array) -> Array:
        i, j = np.floor(x).astype(int), np.floor(y).astype(int)
        s, t = x - i, y - j
        a, b, c, d = (self._at(i + k % 2, j + k // 2) > own for k in range(4))
        return (1 - t) * ((1 - s) * a + s * b) + t * ((1 - s) * c + s * d)

    def lit(self, p: Array, normal: Array, facing: Array, softness: float) -> Array:
        """Return the share of the key light that arrives at points, shape (n,)."""
        texel = 1 / self.scale
        c = self.corner(p + ((1.2 + 1.5 * (1 - facing)) * texel)[:, None] * normal)
        own = c[:, 2] + 1.5 * texel / self.deep
        x, y = c[:, 0], c[:, 1]
        limit, blocked, total = BLOCK - 2.0, np.zeros(len(p)), np.zeros(len(p))
        for dx, dy in (*AROUND, (0, 0)):
            n = self._at((x + limit * dx + 0.5).astype(int), (y + limit * dy + 0.5).astype(int))
            blocked, total = blocked + np.where(n > own, n - own, 0), total + (n > own)
        wide = softness * blocked / np.maximum(total, 1) * self.deep * self.scale
        radius = np.minimum(limit, np.maximum(0.8, wide))
        sums = [
            sum(self._filtered(x + radius * dx, y + radius * dy, own) for dx, dy in places)
            for places in (AROUND, np.stack([-AROUND[:, 1], AROUND[:, 0]], -1), -AROUND)
        ]
        found = 1 - np.where(radius < 1.5, sums[0] / 12, sum(sums) / 36)
        return np.where(total == 0, 1, found)


def _shadow(scene: dict[str, Array], mesh: _Mesh, size: int) -> _Shadow | None:
    ahead = -unit(scene["light"][:3])
    other = np.array([0, 0, 1] if abs(ahead[2]) < 0.9 else [0, 1, 0], np.float32)
    right = unit(np.cross(ahead, other))
    axes = np.stack([right, np.cross(right, ahead), ahead])
    used = mesh.pos[np.unique(mesh.face[mesh.casts])] @ axes.T
    points, radius = scene["particle_pos"] @ axes.T, scene["particle_radius"][:, None]
    held = np.concatenate([used, points - radius, points + radius])
    if not len(held):
        return None
    low, high = held.min(0), held.max(0)
    wide = 1.04 * max(float((high - low)[:2].max()), 0.8)
    near = np.full((size, size), FAR, np.float32)
    start = 0.5 * (low + high - wide)[:2]
    made = _Shadow(near, axes, start, size / wide, high[2], max(high[2] - low[2], 1e-3))
    corners = made.corner(mesh.pos)
    for k in np.flatnonzero(mesh.casts):
        _draw(corners[mesh.face[k]], 0, True, near, None)
    y, x = np.mgrid[:size, :size]
    for (cx, cy, w), r in zip(made.corner(scene["particle_pos"]), scene["particle_radius"], strict=True):
        inside = (x - cx) ** 2 + (y - cy) ** 2 <= (r * made.scale) ** 2
        near[inside] = np.maximum(near[inside], w)
    return made


def _picture(
    scene: dict[str, Array],
    mesh: _Mesh,
    camera: _Camera,
    shadow: _Shadow | None,
    settings: dict[str, int],
    out: dict[str, Array | None],
) -> None:
    """Fill the pictures of one camera."""
    step = 2 if settings["samples"] == 4 else 1
    shape = (settings["height"], settings["width"])
    size = (step * shape[0], step * shape[1])
    near: Array = np.zeros(size, np.float32)
    number: Array = np.full(size, -1)
    local = camera.local(mesh.pos).astype(np.float32)

    def corner(p: Array) -> Array:
        w = 1 / p[..., 2:]
        at = camera.focal * p[..., :2] * w + camera.middle
        return np.concatenate([at if step == 1 else 2 * at + 0.5, w], -1).astype(np.float32)

    for k, face in enumerate(mesh.face):
        for triangle in _clipped(local[face]):
            _draw(corner(triangle), k, False, near, number)
    balls = camera.local(scene["particle_pos"]).astype(np.float32)
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float32)
    for k, (p, r) in enumerate(zip(balls, scene["particle_radius"], strict=True)):
        if p[2] - r <= NEAR:
            continue
        c, wide = corner(p), step * camera.focal * r / p[2]
        d = ((x - c[0]) / wide[0]) ** 2 + ((y - c[1]) / wide[1]) ** 2
        w = 1 / (p[2] - r * np.sqrt(np.maximum(1 - d, 0)))
        hit = (d <= 1) & (w > near)
        near[hit], number[hit] = w[hit], len(mesh.face) + k
    # Samples of a pixel last, in the order of their rows.
    near, number = (
        v.reshape(shape[0], step, shape[1], step).transpose(0, 2, 1, 3).reshape(*shape, -1) for v in (near, number)
    )
    _masks(scene, mesh, near, number, out)
    if out["rgb"] is None:
        return
    total, count = np.zeros((*shape, 3)), step * step
    kind = np.concatenate([mesh.owner, -2 - np.arange(len(balls)), [-1]])[number]
    done = np.zeros(number.shape, bool)
    for k in range(count):
        alike = (number == number[..., k : k + 1]) | (
            (kind == kind[..., k : k + 1])
            & (kind >= 0)
            & (np.abs(near - near[..., k : k + 1]) < 0.004 * near[..., k : k + 1])
        )
        alike &= ~done & ~done[..., k : k + 1]
        many = alike.sum(-1)
        at = many > 0
        off = (np.arange(count) % step, np.arange(count) // step)
        px, py = ((alike * (0.5 * o - 0.25) * (step - 1)).sum(-1)[at] / many[at] for o in off)
        yy, xx = np.nonzero(at)
        total[at] += many[at][:, None] * _color(
            scene, mesh, camera, shadow, balls, number[..., k][at], xx + px, yy + py
        )
        done |= alike
    out["rgb"][...] = encoded(total / count)


def _clipped(triangle: Array) -> list[Array]:
    """Return what of a triangle is before the camera, as triangles."""
    ahead = triangle[:, 2] > NEAR
    if ahead.all() or not ahead.any():
        return [triangle] if ahead.all() else []
    kept = []
    for k in range(3):
        a, b = triangle[k], triangle[(k + 1) % 3]
        if ahead[k]:
            kept.append(a)
        if ahead[k] != ahead[(k + 1) % 3]:
            kept.append(a + (NEAR - a[2]) / (b[2] - a[2]) * (b - a))
    return [np.stack([kept[0], kept[k - 1], kept[k]]) for k in range(2, len(kept))]


def _masks(scene: dict[str, Array], mesh: _Mesh, near: Array, number: Array, out: dict[str, Array | None]) -> None:
    names = np.concatenate([scene["piece_id"], scene["rope_id"]])[mesh.owner]
    names = np.concatenate([names, scene["group_id"][scene["particle_group"]], [0]])[number]
    votes = (names[..., None] == names[..., None, :]).sum(-1)
    best = np.take_along_axis(names, votes.argmax(-1)[..., None], -1)
    if out["ids"] is not None:
        out["ids"][...] = best[..., 0]
    if out["depth"] is not None:
        total = np.where(names == best, near, 0).sum(-1)
        out["depth"][...] = np.where(total > 0, votes.max(-1) / np.where(total > 0, total, 1), np.inf)


def _color(
    scene: dict[str, Array],
    mesh: _Mesh,
    camera: _Camera,
    shadow: _Shadow | None,
    balls: Array,
    number: Array,
    x: Array,
    y: Array,
) -> Array:
    """Return the colours of what triangles show at places of the picture, shape (n, 3)."""
    at = np.stack([x, y], -1)
    ray = np.concatenate([(at - camera.middle) / camera.focal, np.ones((len(at), 1))], -1).astype(np.float32)
    found, pieces, light = np.empty((len(at), 3), np.float32), len(scene["piece_id"]), scene["light"]
    nothing, ball = number < 0, number >= len(mesh.face)
    found[nothing] = background_light(light, camera.eye, unit(ray[nothing] @ camera.turn))
    if ball.any():
        k = number[ball] - len(mesh.face)
        c, r = balls[k], scene["particle_radius"][k][:, None]
        d = (ray[ball, :2] - c[:, :2] / c[:, 2:]) * c[:, 2:] / r
        n = unit(np.concatenate([d, -np.sqrt(1 - np.minimum(0.98, (d * d).sum(-1, keepdims=True)))], -1)) @ camera.turn
        p = (c - camera.shift) @ camera.turn + r * n
        m = scene["group_material"][scene["particle_group"][k]]
        found[ball] = surface_light(light, shadow, p, n, unit(camera.eye - p), m[:, :3], m[:, 6])
    flat = ~nothing & ~ball
    if not flat.any():
        return found
    face, owner, ray = mesh.face[number[flat]], mesh.owner[number[flat]], ray[flat]
    a, b, c = (camera.local(mesh.pos[face[:, k]]) for k in range(3))
    h, q = np.cross(ray, c - a), np.cross(-a, b - a)
    det = dot(b - a, h)
    over = np.where(det != 0, 1 / np.where(det != 0, det, 1), 0)
    u, v = np.clip(dot(-a, h) * over, 0, 1), np.clip(dot(ray, q) * over, 0, 1)
    share = np.stack([1 - u - v, u, v], -1)
    share = np.where((u + v > 1)[:, None], np.stack([0 * u, u, v], -1) / np.maximum(u + v, 1e-9)[:, None], share)
    p, n, uv = ((share[..., None] * w[face]).sum(1) for w in (mesh.pos, mesh.normal, mesh.uv))
    n, out = unit(n), camera.eye - p
    away = np.sqrt(dot(out, out))
    to_eye = out / np.maximum(away, 1e-9)[:, None]
    blur = away / camera.focal[0] / np.maximum(0.15, np.abs(dot(n, to_eye)))
    m = np.concatenate([scene["piece_material"], scene["rope_material"]])[owner]
    rope = (owner >= pieces)[:, None]
    found[flat] = surface_light(light, shadow, p, n, to_eye, surface_colors(m, p, np.where(rope, uv, 0), blur), m[:, 6])
    return found
