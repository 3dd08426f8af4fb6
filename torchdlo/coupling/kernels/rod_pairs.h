// Pairs of edges of ropes side by side: where they touch, how they move, and what forces between them exert, with the
// derivatives of all three. Formulas and names as in contact.py and segments.py.
#pragma once
#include "segments.h"

// A pair as its corners make it, or derivatives by it. Of the corners, 0 and 1 are the ends of the first edge, 2 and 3
// those of the second.
template <typename T>
struct Pair {
  typedef Num<T, 0> P;
  typedef Three<T, 0> V;
  P s, t;                    // where the closest points lie on the edges
  V normal, between;         // both from the second edge to the first; of length 1, and as long as they are apart
  V arm[4];                  // of corners in the couple of friction
  P xx, yy, zz, xy, xz, yz;  // inverse of the moments of inertia
  P turning;                 // by how much the couple adds to the slip
  P wanted;                  // by how much the surfaces have to part

  V turned(const V& c) const {
    return {xx * c.x + xy * c.y + xz * c.z, xy * c.x + yy * c.y + yz * c.z, xz * c.x + yz * c.y + zz * c.z};
  }
};
template <typename T>
struct Corners {
  Three<T, 0> pos[4];
  Num<T, 0> free[4], radius[2];
};
template <typename T>
struct Force {
  Num<T, 0> normal;
  Three<T, 0> friction;
};

// How corners exert the couple of friction, see `_couple` in contact.py: masses up to a factor, those of the edges,
// corners from the centres of their edges, and these from the centre of all.
template <typename T>
struct Brace {
  typedef Num<T, 0> P;
  typedef Three<T, 0> V;
  P mass[4], both[2], share;
  V own[4], far, apart[2];

  static P weak() { return P(T(WEAK)); }
  static P root_weak() { return P(T(ROOT_WEAK)); }
  static P little() { return P(sizeof(T) == 8 ? T(1e-14) : T(1e-6)); }

  explicit Brace(const Corners<T>& c) {
    const P one(T(1));
    V centre[2];
    for (int i = 0; i < 4; ++i) mass[i] = one / c.free[i];
    for (int k = 0; k < 2; ++k) {
      const int i = 2 * k, j = i + 1;
      both[k] = mass[i] + mass[j];
      centre[k] = (c.pos[i] * mass[i] + c.pos[j] * mass[j]) * (one / both[k]);
      own[i] = c.pos[i] - centre[k], own[j] = c.pos[j] - centre[k];
    }
    share = both[0] / (both[0] + both[1]);
    far = centre[0] - centre[1], apart[0] = far * (one - share), apart[1] = far * -share;
  }
  V lever(int i) const { return own[i] + apart[i / 2] * root_weak(); }
  V arm(int i) const { return own[i] + apart[i / 2] * weak(); }

  void apply(const P& distance, Pair<T>& a) const {
    P xx(T(0)), yy = xx, zz = xx, xy = xx, xz = xx, yz = xx;
    for (int i = 0; i < 4; ++i) {
      const V l = lever(i), ml = l * mass[i];
      xx = xx + ml.x * l.x, yy = yy + ml.y * l.y, zz = zz + ml.z * l.z;
      xy = xy + ml.x * l.y, xz = xz + ml.x * l.z, yz = yz + ml.y * l.z;
      a.arm[i] = arm(i) * mass[i];
    }
    const P more = little() * (xx + yy + zz) + P(T(sizeof(T) == 8 ? 1.221338669755462e-77 : 3.2927225399135965e-10));
    const P x = yy + zz + more, y = xx + zz + more, z = xx + yy + more, d = -xy, e = -xz, f = -yz;
    const P first = y * z - f * f, second = e * f - d * z, third = d * f - y * e;
    const P inverse = P(T(1)) / (x * first + d * second + e * third);
    a.xx = first * inverse, a.xy = second * inverse, a.xz = third * inverse;
    a.yy = (x * z - e * e) * inverse, a.yz = (d * e - x * f) * inverse, a.zz = (x * y - d * d) * inverse;
    a.turning = distance * distance * stiffest(a);
  }
  static P stiffest(const Pair<T>& a) { return a.xx + a.yy + a.zz - dot(a.normal, a.turned(a.normal)); }

  // Adds derivatives by the corners, and by the distance and the normal, of what `apply` made.
  void back(const Pair<T>& a, const P& distance, Pair<T>& d, P& by_distance, Corners<T>& to) const {
    const P two(T(2)), half(T(0.5)), one(T(1));
    const V& n = a.normal;
    by_distance = by_distance + two * distance * d.turning * stiffest(a);
    const P g = distance * distance * d.turning;
    d.normal -= a.turned(n) * (two * g);
    // The derivative G by the inverse J becomes -J G J by the matrix.
    const P xx = d.xx + g * (one - n.x * n.x), yy = d.yy + g * (one - n.y * n.y), zz = d.zz + g * (one - n.z * n.z);
    const P xy = half * d.xy - g * n.x * n.y, xz = half * d.xz - g * n.x * n.z, yz = half * d.yz - g * n.y * n.z;
    const V rows[3] = {{a.xx, a.xy, a.xz}, {a.xy, a.yy, a.yz}, {a.xz, a.yz, a.zz}};
    V middle[3];
    for (int k = 0; k < 3; ++k) {
      const V& r = rows[k];
      middle[k] = {xx * r.x + xy * r.y + xz * r.z, xy * r.x + yy * r.y + yz * r.z, xz * r.x + yz * r.y + zz * r.z};
    }
    const auto product = [&](int i, int j) { return -dot(rows[i], middle[j]); };
    const P x = product(0, 0), y = product(1, 1), z = product(2, 2), all = (one + little()) * (x + y + z);
    const V columns[3] = {{all - x, -product(0, 1), -product(0, 2)},
                          {-product(1, 0), all - y, -product(1, 2)},
                          {-product(2, 0), -product(2, 1), all - z}};
    V by_centre[2], by_apart[2];
    P by_mass[4];
    for (int k = 0; k < 2; ++k) by_centre[k] = by_apart[k] = {P(T(0)), P(T(0)), P(T(0))};
    for (int i = 0; i < 4; ++i) {
      const V l = lever(i), turned = {dot(columns[0], l), dot(columns[1], l), dot(columns[2], l)};
      const V by_lever = turned * (two * mass[i]), by_arm = d.arm[i] * mass[i], by_own = by_lever + by_arm;
      by_mass[i] = dot(l, turned) + dot(d.arm[i], arm(i));
      by_apart[i / 2] += by_lever * root_weak() + by_arm * weak();
      to.pos[i] += by_own, by_centre[i / 2] -= by_own;
    }
    const V by_far = by_apart[0] * (one - share) - by_apart[1] * share;
    by_centre[0] += by_far, by_centre[1] -= by_far;
    const P by_share = -dot(far, by_apart[0] + by_apart[1]) / (both[0] + both[1]);
    for (int i = 0; i < 4; ++i) {
      const int k = i / 2;
      const V c = by_centre[k] * (one / both[k]);
      to.pos[i] += c * mass[i];
      const P m = by_mass[i] + dot(c, own[i]) + (k ? -(by_share * share) : by_share * (one - share));
      to.free[i] = to.free[i] - mass[i] * mass[i] * m;
    }
  }
};

template <typename T>
static Pair<T> pair(const Corners<T>& c, bool friction, T recovery) {
  typedef Num<T, 0> P;
  Pair<T> a;
  closest(c.pos, a.s, a.t);
  a.between = c.pos[0] + (c.pos[1] - c.pos[0]) * a.s - c.pos[2] - (c.pos[3] - c.pos[2]) * a.t;
  const P distance = measured(a.between, a.normal), thick = c.radius[0] + c.radius[1], over = thick - distance;
  const P deep = P(T(1) - recovery) * positive(over - P(T(0.05)) * thick);
  a.wanted = select(over.x < T(0), over, P(recovery) * over + deep);
  if (friction) Brace<T>(c).apply(distance, a);
  return a;
}
// Adds the derivative by the corners of a pair that is apart.
template <typename T>
static void pair_back(const Corners<T>& c, const Pair<T>& a, bool friction, T recovery, Pair<T> d, Corners<T>& to) {
  typedef Num<T, 0> P;
  typedef Three<T, 0> V;
  V normal;
  const P zero(T(0)), one(T(1)), distance = measured(a.between, normal), thick = c.radius[0] + c.radius[1];
  const P over = thick - distance, shallow = P(T(0.05)) * thick;
  const P deep = select(over.x - shallow.x < T(0), zero, P(T(1) - recovery) * d.wanted);
  const auto free = over.x < T(0);
  const P by_over = select(free, d.wanted, P(recovery) * d.wanted + deep);
  const P by_radius = by_over - select(free, zero, P(T(0.05)) * deep);
  for (int k = 0; k < 2; ++k) to.radius[k] = to.radius[k] + by_radius;
  P by_distance = -by_over;
  if (friction) Brace<T>(c).back(a, distance, d, by_distance, to);
  const P inverse = one / select(distance.x > T(0), distance, one);
  const V by = d.between + (d.normal - normal * dot(normal, d.normal)) * inverse + normal * by_distance;
  const V one_part = by * a.s, two_part = by * a.t;
  to.pos[0] += by - one_part, to.pos[1] += one_part, to.pos[2] -= by - two_part, to.pos[3] -= two_part;
  d.s = d.s + dot(by, c.pos[1] - c.pos[0]), d.t = d.t - dot(by, c.pos[3] - c.pos[2]);
  closest_back(c.pos, d.s, d.t, to.pos);
}

// Forces on corners.
template <typename T>
static inline void exert(const Pair<T>& a, const Force<T>& f, bool friction, Three<T, 0>* to) {
  const Three<T, 0> whole = a.normal * f.normal + f.friction, one = whole * a.s, two = whole * a.t;
  to[0] = whole - one, to[1] = one, to[2] = two - whole, to[3] = two * Num<T, 0>(T(-1));
  if (!friction) return;
  const Three<T, 0> turn = a.turned(cross(a.between, f.friction));
  for (int i = 0; i < 4; ++i) to[i] -= cross(turn, a.arm[i]);
}
template <typename T>
static inline Three<T, 0> apart(const Pair<T>& a, const Three<T, 0>* x) {
  return x[0] + (x[1] - x[0]) * a.s - x[2] - (x[3] - x[2]) * a.t;
}
template <typename T>
static inline Three<T, 0> moment(const Pair<T>& a, const Three<T, 0>* x) {
  return cross(a.arm[0], x[0]) + cross(a.arm[1], x[1]) + cross(a.arm[2], x[2]) + cross(a.arm[3], x[3]);
}
// How displacements of corners part and slip a pair: the transpose of what forces exert.
template <typename T>
static inline Force<T> seen(const Pair<T>& a, const Three<T, 0>* x, bool friction) {
  const Three<T, 0> d = apart(a, x);
  if (!friction) return {dot(a.normal, d), d};
  return {dot(a.normal, d), d - cross(a.turned(moment(a, x)), a.between)};
}
// Adds the derivative by the pair of force . seen = exerted . displacements.
template <typename T>
static inline void tilt(const Pair<T>& a, const Force<T>& f, const Three<T, 0>* x, bool friction, Pair<T>& to) {
  typedef Three<T, 0> V;
  const V whole = a.normal * f.normal + f.friction;
  to.s = to.s + dot(whole, x[1] - x[0]), to.t = to.t - dot(whole, x[3] - x[2]);
  to.normal += apart(a, x) * f.normal;
  if (!friction) return;
  const V c = cross(a.between, f.friction), m = moment(a, x), turn = a.turned(c);
  to.between -= cross(f.friction, a.turned(m));
  for (int i = 0; i < 4; ++i) to.arm[i] -= cross(x[i], turn);
  to.xx = to.xx - c.x * m.x, to.yy = to.yy - c.y * m.y, to.zz = to.zz - c.z * m.z;
  to.xy = to.xy - c.x * m.y - c.y * m.x, to.xz = to.xz - c.x * m.z - c.z * m.x, to.yz = to.yz - c.y * m.z - c.z * m.y;
}

// Values of a field of vertices at corners, their sum to the vertices, and the sum of some lanes.
template <typename T>
static inline Num<T, 0> pick(const T* field, const int* at) {
#ifdef SIMT
  return Num<T, 0>(field[*at]);
#else
  T found[WIDTH<T>];
  for (int i = 0; i < WIDTH<T>; ++i) found[i] = field[at[i]];
  Num<T, 0> x;
  std::memcpy(&x.x, found, sizeof(found));
  return x;
#endif
}
template <typename T>
static inline void drop(const Num<T, 0>& x, T* field, const int* at, int count) {
  for (int i = 0; i < count; ++i) ADD(field[at[i]], x.x[i]);
}
template <typename T>
static inline T sum(const Num<T, 0>& x, int count) {
  T s = 0;
  for (int i = 0; i < count; ++i) s += x.x[i];
  return s;
}
