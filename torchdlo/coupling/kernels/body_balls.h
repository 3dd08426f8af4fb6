// Where two bodies touch: the same formulas as in balls.py, for scenes side by side.
#pragma once
#include "edge_points.h"

// Numbers of a body that contact among bodies depends on, or derivatives by them.
template <typename T, int N>
struct Member {
  typedef Num<T, N> S;
  typedef Three<T, N> V;
  V pos, axes[3];
  S offset, numbers[4], arc;
  V vel, omega, change, turn;
  S mobility;
  V agility;
  S mu_s, mu_k, restitution;

  V local(const V& a) const { return {dot(axes[0], a), dot(axes[1], a), dot(axes[2], a)}; }
  V world(const V& a) const { return axes[0] * a.x + axes[1] * a.y + axes[2] * a.z; }
  V turned(const V& torque) const {
    const V t = local(torque);
    return world({agility.x * t.x, agility.y * t.y, agility.z * t.z});
  }
  V resisted(const V& turn) const {
    const V t = local(turn);
    return world({t.x / agility.x, t.y / agility.y, t.z / agility.z});
  }
};

template <typename T, int N>
struct Touch {
  Three<T, N> normal, point;
  Num<T, N> gap;
};

enum Kind { STANDING, CIRCLE, SEGMENT };

// A ball of the first body in the field of the second.
struct Candidate {
  int first, second, kind, number;
};

struct Sizes {
  int64_t bodies, scenes, pairs, points, steps, hold;  // hold: whether to say how contact holds bodies
  const int64_t *shape, *free, *pair;  // per body; its place among free bodies, or -1; two bodies per pair
  const int64_t *cells, *many;         // three per body, and how many balls stand for a mesh
  const void *grids, *balls;           // of all bodies, each with so many corners, and with so many numbers
  int64_t corners, numbers;
  double recovery, shallow, slowest, fastest, dt;
  template <typename T>
  Grid<T> grid(int body) const {
    return {(const T*)grids + body * corners, cells + 3 * body};
  }
  template <typename T>
  const T* ball(int body, int number) const {
    return (const T*)balls + body * numbers + 4 * number;
  }
  int how_many(int kind, int body) const {
    static const int counts[3][9] = {
        {0, 1, 8, 2, 2 * FEET, FEET + 1, FEET, ARC, 0}, {0, 0, 0, 0, 2, 1, 1, 0, 0}, {0, 0, 12, 1, 1, 0, 0, 0, 0}};
    return kind == STANDING && shape[body] == MESH ? int(many[body]) : counts[kind][shape[body]];
  }
};

// The least of some numbers; equal ones share the derivative.
NUM least(const Num<T, N>* x, int count) {
  typedef Num<T, N> S;
  const S zero(T(0)), one(T(1));
  Lanes<T> low = x[0].x;
  for (int k = 1; k < count; ++k) low = x[k].x < low ? x[k].x : low;
  S sum = zero, many = zero;
  for (int k = 0; k < count; ++k) {
    const auto here = x[k].x == low;
    sum = sum + select(here, x[k], zero), many = many + select(here, one, zero);
  }
  return sum / many;
}

// Radius of rounded edges.
NUM rounding(const Member<T, N>& body, int shape, int field) {
  static const int sizes[] = {0, 1, 3, 2, 2, 2, 2, 0, 0};
  if (field == PLANE || !sizes[shape]) return Num<T, N>(T(0));
  return least(body.numbers, sizes[shape]) * Num<T, N>(T(shape == CONE ? 0.5 * ROUND : ROUND));
}

// By how many radii a ball that touches base and slope of a cone is inside the rim.
NUM slack(const Num<T, N>& a, const Num<T, N>& b) { return (root(a * a + b * b) + a) / b; }

// Height, radius and thickness of the circles of a cylinder, cone or torus.
template <typename T, int N>
static inline Three<T, N> circle(const Member<T, N>& body, int shape, int number, const Num<T, N>& edge) {
  typedef Num<T, N> S;
  const S &a = body.numbers[0], &b = body.numbers[1];
  if (shape == TORUS) return {S(T(0)), a, b};
  if (shape == CONE) return {edge - S(T(0.25)) * b, a - slack(a, b) * edge, edge};
  return {number ? b - edge : edge - b, a - edge, edge};
}

// Centre of a fixed ball in the frame of its body; returns its radius.
template <typename T, int N>
static Num<T, N> standing(const Member<T, N>& body, int shape, int number, const Num<T, N>& edge, Three<T, N>& at) {
  typedef Num<T, N> S;
  const S zero(T(0)), &a = body.numbers[0], &b = body.numbers[1];
  if (shape == BOX) {
    const auto side = [&](int k) { return number >> (2 - k) & 1 ? body.numbers[k] - edge : edge - body.numbers[k]; };
    at = {side(0), side(1), side(2)};
    return edge;
  }
  if (shape == CAPSULE) {
    at = {zero, zero, number ? b : -b};
    return a;
  }
  if (shape == RING) {
    S c, s;
    turn(body.arc * S(T(number) / (ARC - 1) - T(0.5)), c, s);
    at = {a * c - body.offset, a * s, zero};
    return b;
  }
  if (shape == CONE && number == FEET) {
    const S steep = b / a, below = edge * root(S(T(1)) + steep * steep);
    at = {zero, zero, S(T(0.75)) * b - below};
    return edge;
  }
  if (shape == SPHERE) {
    at = {zero, zero, zero};
    return a;
  }
  const double angle = 2 * M_PI * (number % FEET) / FEET;
  const Three<T, N> ring = circle(body, shape, number / FEET, edge);
  at = {ring.y * S(T(std::cos(angle))), ring.y * S(T(std::sin(angle))), ring.x};
  return ring.z;
}

// Ends of a segment in the frame of its body; returns the radius of its balls.
template <typename T, int N>
static Num<T, N> segment(const Member<T, N>& body, int shape, int number, const Num<T, N>& edge, Three<T, N>* ends) {
  typedef Num<T, N> S;
  const S zero(T(0)), &a = body.numbers[0], &b = body.numbers[1];
  if (shape == BOX) {  // corners that differ in one coordinate
    for (int i = 0; i < 8; ++i)
      for (int j = i + 1; j < 8; ++j) {
        if ((i ^ j) & ((i ^ j) - 1) || number--) continue;
        standing(body, shape, i, edge, ends[0]), standing(body, shape, j, edge, ends[1]);
      }
    return edge;
  }
  const S thick = shape == CAPSULE ? a : least(body.numbers, 2), far = shape == CAPSULE ? b : b - thick;
  ends[0] = {zero, zero, -far}, ends[1] = {zero, zero, far};
  return thick;
}

// A ball of one body in the field of another; `late` is how much later than others of its gap it counts. The search for
// the nearest point of a segment is done without derivatives, and found before otherwise.
template <typename T, int N>
static Touch<T, N> touch(const Candidate& c, const Member<T, N>& one, const Member<T, N>& other, const Sizes& n,
                         Found<T>& found, Num<T, N>& late) {
  typedef Num<T, N> S;
  typedef Three<T, N> V;
  const int shape = int(n.shape[c.first]), field = int(n.shape[c.second]);
  const Grid<T> grid = n.grid<T>(c.second);
  const S zero(T(0)), edge = rounding(one, shape, field);
  const V between = one.pos - other.pos;
  const auto seen = [&](const V& a) {
    V p = other.local(one.world(a) + between);
    p.x = p.x + other.offset;
    return p;
  };
  S thick, r[5];
  V at, p;
  late = zero;
  if (c.kind == SEGMENT) {
    V ends[2];
    thick = segment(one, shape, c.number, edge, ends);
    const V start = seen(ends[0]), along = seen(ends[1]) - start;
    const Line<T, N> line(field, grid, start, along, other.numbers);
    if constexpr (N == 0) found = nearest<T>(line, T(0), T(1));
    end<T, N>(line, &found, T(0.5), r);
    p = start + along * r[0];
    late = edge * S(T(0.25));
  } else {
    if (c.kind == STANDING && shape == MESH) {
      const T* ball = n.ball<T>(c.first, c.number);
      at = {S(ball[0]), S(ball[1]), S(ball[2])}, thick = S(ball[3]);
    } else if (c.kind == STANDING) {
      thick = standing(one, shape, c.number, edge, at);
    }
    if (c.kind == CIRCLE) {
      const V ring = circle(one, shape, c.number, edge), middle = seen({zero, zero, ring.x});
      V out, way;
      probe(field, grid, other.numbers, &middle.x, &out.x);
      const V down = one.local(other.world(out)), flat = {-down.x, -down.y, zero};
      const S steep = measured(flat, way), share = ring.y / larger(steep, S(T(FLAT)));
      at = {flat.x * share, flat.y * share, ring.x};
      thick = ring.z;
    }
    p = seen(at);
    r[1] = probe(field, grid, other.numbers, &p.x, r + 2);
  }
  const V normal = {r[2], r[3], r[4]};
  p.x = p.x - other.offset;
  const V middle = p - normal * (S(T(0.5)) * (r[1] + thick));
  return {other.world(normal), other.world(middle) + other.pos, r[1] - thick};
}
