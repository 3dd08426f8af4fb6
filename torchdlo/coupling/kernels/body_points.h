// Ropes, bodies, and points of edges on bodies for a block of scenes side by side: how points come about, how they move,
// and what forces on them exert, with the derivatives of all three.
#pragma once
#include "edge_points.h"

template <typename T>
struct Point {
  Lanes<T> share;
  Vec<T> normal, arm;
  Lanes<T> wanted, turning, sliding;
};
template <typename T>
struct Edge {
  Vec<T> tangent;
  Lanes<T> lever, radius, real;
};
template <typename T>
struct Vertex {
  Vec<T> pos, vel, change, answer;
  Lanes<T> soft;
};
template <typename T>
struct Solid {
  Vec<T> pos, axes[3], offset;
  Lanes<T> numbers[4];
  Vec<T> vel, omega, change, turn;
  Lanes<T> mobility, xx, yy, zz, xy, xz, yz, agile, mu_s, mu_k, restitution;
  Vec<T> turned(const Vec<T>& t) const {
    return {xx * t.x + xy * t.y + xz * t.z, xy * t.x + yy * t.y + yz * t.z, xz * t.x + yz * t.y + zz * t.z};
  }
  void add_turned(const Vec<T>& a, const Vec<T>& b) {  // derivative of a . turned(b)
    xx += a.x * b.x, yy += a.y * b.y, zz += a.z * b.z;
    xy += a.x * b.y + a.y * b.x, xz += a.x * b.z + a.z * b.x, yz += a.y * b.z + a.z * b.y;
  }
  Vec<T> local(const Vec<T>& a) const { return {dot(axes[0], a), dot(axes[1], a), dot(axes[2], a)}; }
  Vec<T> world(const Vec<T>& a) const { return axes[0] * a.x + axes[1] * a.y + axes[2] * a.z; }
  void add_world(const Vec<T>& by, const Vec<T>& a) {  // derivative by the axes of by . world(a)
    axes[0] += by * a.x, axes[1] += by * a.y, axes[2] += by * a.z;
  }
};
template <typename T>
struct Force {
  Lanes<T> normal;
  Vec<T> friction;
};
template <typename T>
struct Wrench {
  Vec<T> force, torque;
};

struct Sizes {
  int64_t families, vertices, bodies, scenes, sweeps, friction;
  const int64_t *shape, *pieces, *after, *cells;  // per body, vertex after each vertex, and three per body
  const void* grids;                              // of all bodies, each with so many corners
  int64_t corners;
  double recovery, slowest, dt;
  template <typename T>
  Grid<T> grid(int body) const {
    return {(const T*)grids + body * corners, cells + 3 * body};
  }
};

// Numbers that contact depends on, or derivatives by them.
template <typename T>
struct Inputs {
  List<Edge<T>> edges;
  List<Vertex<T>> vertices;
  List<Solid<T>> bodies;
  List<Point<T>> points;  // made of the others

  void take(const Sizes& n, Memory& memory) {
    memory.common(edges, n.vertices), memory.common(vertices, n.vertices), memory.common(bodies, n.bodies);
    memory.large(points, n.families * n.vertices);
  }
  template <typename P>
  void all(P work) {
    work(edges, 0), work(vertices, 1), work(bodies, 2);
  }
};

template <typename T>
struct Geometry : Inputs<T> {
  using Inputs<T>::points;
  using Inputs<T>::edges;
  using Inputs<T>::vertices;
  using Inputs<T>::bodies;
  typedef Lanes<T> L;
  typedef Vec<T> R;
  typedef List<R> Shifts;
  typedef List<Wrench<T>> Turns;
  Sizes n;
  struct Far {  // an edge, a body, and how much nearer they have to come before points of them matter
    int edge, body;
    bool late;  // whether they have
    L gap, arm;
  };
  List<int> owner, piece, first;  // body of each family; piece of an edge, or -2 and -1 for its ends; by body
  List<int> near;                 // points that may press
  List<Far> far;                  // where there are none
  List<Found<T>> found;
  List<char> searched;
  List<L> distance;
  Shifts change, vel;  // how vertices move now
  Turns motion, spin;  // and bodies

  Geometry(const Sizes& n, Memory& memory) : n(n) {
    this->take(n, memory);
    memory.common(change, n.vertices), memory.common(vel, n.vertices);
    memory.common(motion, n.bodies), memory.common(spin, n.bodies), memory.common(first, n.bodies);
    memory.common(owner, n.families), memory.common(piece, n.families);
    memory.large(found, points.size()), memory.large(searched, points.size()), memory.large(distance, points.size());
    memory.own(near, n.vertices, n.families), memory.own(far, n.vertices, n.bodies);
  }
  void number() {
    int f = 0;
    for (int k = 0; k < n.bodies; ++k) {
      if (lane() == 0) first[k] = f;
      for (int j = -2; j < n.pieces[k]; ++j, ++f)
        if (lane() == 0) owner[f] = k, piece[f] = j;
    }
    meet();
  }

  int edge(int p) const { return p % int(n.vertices); }
  int body(int p) const { return owner[p / int(n.vertices)]; }

  // By how much a point moves against its body without friction's turn.
  R apart(int p, const Shifts& x, const Turns& m) const {
    const Point<T>& a = points[p];
    const int v = edge(p);
    const Wrench<T>& k = m[body(p)];
    const R &i = x[v], &j = x[n.after[v]];
    return i + (j - i) * a.share - k.force - cross(k.torque, a.arm);
  }
  // The turn that friction's couple sees.
  R turned(int p, const Shifts& x, const Turns& m) const {
    const int v = edge(p);
    const Edge<T>& e = edges[v];
    const R stretch = x[n.after[v]] - x[v], &turn = m[body(p)].torque;
    return cross(e.tangent, stretch) * e.lever - (turn - e.tangent * dot(e.tangent, turn)) * e.radius;
  }

  // Adds what forces on points exert on ropes and on the body of the point, and its transpose: motions seen at the points,
  // `slip` with its normal part.
  void exert(int p, const L& normal, const R& friction, Shifts& f, Wrench<T>& m) const {
    const Point<T>& a = points[p];
    const int v = edge(p);
    const Edge<T>& e = edges[v];
    const R whole = a.normal * normal + friction, couple = cross(friction, a.normal);
    const R pair = cross(couple, e.tangent) * e.lever, second = whole * a.share + pair;
    ADD(f[v], whole - second);
    ADD(f[n.after[v]], second);
    m.force -= whole;
    m.torque -= cross(a.arm, whole) + (couple - e.tangent * dot(e.tangent, couple)) * e.radius;
  }
  Force<T> seen(int p, const Shifts& x, const Turns& m) const {
    const R d = apart(p, x, m);
    return {dot(points[p].normal, d), d + cross(points[p].normal, turned(p, x, m))};
  }
  // Adds the derivative by the geometry of (normal, friction) . seen = what they exert . motion.
  void tilt(int p, const L& normal, const R& friction, const Shifts& x, const Turns& m,
            Inputs<T>& to) const {
    const Point<T>& a = points[p];
    const int v = edge(p);
    const Edge<T>& e = edges[v];
    const R stretch = x[n.after[v]] - x[v], &turn = m[body(p)].torque;
    const R whole = a.normal * normal + friction, couple = cross(friction, a.normal);
    Point<T>& da = to.points[p];
    Edge<T>& de = to.edges[v];
    da.share += dot(whole, stretch);
    da.normal += apart(p, x, m) * normal + cross(turned(p, x, m), friction);
    da.arm += cross(turn, whole);
    de.lever += dot(couple, cross(e.tangent, stretch));
    de.radius -= dot(couple, turn - e.tangent * dot(e.tangent, turn));
    de.tangent += cross(stretch, couple) * e.lever +
                  (couple * dot(e.tangent, turn) + turn * dot(e.tangent, couple)) * e.radius;
  }


  void foresee() {
    EVERY(v, n.vertices) change[v] = vertices[v].change, vel[v] = vertices[v].vel;
    EVERY(k, n.bodies)
      motion[k] = {bodies[k].change, bodies[k].turn}, spin[k] = {bodies[k].vel, bodies[k].omega};
  }
  // Places points where edges may come near to bodies; the others wait, see `reach`.
  void prepare() {
    foresee();
    meet();
    near.clear(), far.clear();
    for (int k = 0; k < n.bodies; ++k)
      EVERY(v, n.vertices) {
        Far f = distant(v, k);
#ifdef SIMT  // of several scenes that share an instruction, one is near enough in most cases
        if (soon(f)) f.gap = narrow(v, k);
#endif
        if (soon(f))
          place(v, k);
        else
          far.push_back(f);
      }
  }
  // Places the points of those that go so far by now that they may touch after all; as foreseen, like the others.
  // Returns whether there are any: all move as foreseen then.
  bool reach() {
    bool some = false;
    for (Far& f : far) {
      f.late = any((edges[f.edge].real > T(0)) & ~(f.gap > moved(f)));
      some = some || f.late;
    }
    if (!anyone(some)) return false;
    meet();
    foresee();
    meet();
    size_t kept = 0;
    for (size_t i = 0; i < size_t(far.size()); ++i)
      if (far[i].late)
        place(far[i].edge, far[i].body);
      else
        far[kept++] = far[i];
    far.resize(kept);
    meet();
    return true;
  }

  static L size(const R& x) { return root<T>(dot(x, x)); }
  // By how much an edge and a body come nearer to each other at most.
  L moved(const Far& f) const {
    const L i = size(change[f.edge]), j = size(change[n.after[f.edge]]);
    return (i > j ? i : j) + size(motion[f.body].force) + size(motion[f.body].torque) * f.arm;
  }
  // Whether an edge may touch a body in some scene, if it moves twice as far as foreseen.
  bool soon(const Far& f) const { return any((edges[f.edge].real > T(0)) & ~(f.gap > T(2) * moved(f))); }
  // How far an edge is from a body at least: no point of it is nearer than its ends by more than its distance from them.
  L narrow(int v, int k) const {
    const Solid<T>& b = bodies[k];
    const R from = vertices[v].pos, to = vertices[n.after[v]].pos;
    const Line<T, 0> line(n.shape[k], n.grid<T>(k), b.local(from - b.pos) + b.offset, b.local(to - from), b.numbers);
    Num<T, 0> normal[3];
    const L ends = line.at(Num<T, 0>(T(0)), normal).x + line.at(Num<T, 0>(T(1)), normal).x;
    return T(0.5) * (ends - line.length.x) - edges[v].radius;
  }
  // How far an edge is from the ball about a body, or from a plane.
  Far distant(int v, int k) const {
    const Solid<T>& b = bodies[k];
    const R from = vertices[v].pos - b.pos, way = vertices[n.after[v]].pos - vertices[v].pos;
    const R at = b.local(from) + b.offset;
    const L length = size(way), out = n.shape[k] == PLANE ? at.z : size(at) - bounding<T>(n.shape[k], b.numbers);
    return {v, k, false, out - length - edges[v].radius, size(from) + length};
  }

  // Whether an edge may come within a radius of a body in some scene, if it moves twice as far as foreseen.
  bool close(int p, const Line<T, 0>& line) const {
    const int v = edge(p), k = body(p), start = first[k] * n.vertices + v;
    const L reach = T(2) * (edges[v].radius + moved({v, k, false, L{}, size(points[start].arm) + line.length.x}));
    return any((edges[v].real > T(0)) & (distance[start] - line.length.x <= reach));
  }
  T share(int family) const {
    const int j = piece[family];
    return j < 0 ? T(j + 2) : T((j + 0.5) / n.pieces[owner[family]]);
  }
  template <int N>
  Line<T, N> line(int p) const {
    const int k = body(p);
    const Solid<T>& b = bodies[k];
    const R from = vertices[edge(p)].pos, to = vertices[n.after[edge(p)]].pos;
    return Line<T, N>(n.shape[k], n.grid<T>(k), b.local(from - b.pos) + b.offset, b.local(to - from), b.numbers);
  }

  void place(int v, int k) {
    for (int f = first[k]; f < first[k] + 2 + n.pieces[k]; ++f) near.push_back(f * n.vertices + v), place(near.back());
  }
  void place(int p) {
    const int f = p / n.vertices, v = edge(p);
    const Solid<T>& b = bodies[body(p)];
    const Line<T, 0> line = this->template line<0>(p);
    searched[p] = piece[f] >= 0 && close(p, line);
    if (searched[p]) {
      const T count = n.pieces[body(p)];
      found[p] = nearest<T>(line, piece[f] / count, (piece[f] + 1) / count);
    }
    Num<T, 0> r[5];
    end<T, 0>(line, searched[p] ? &found[p] : nullptr, share(f), r);
    Point<T>& a = points[p];
    const R from = vertices[v].pos, to = vertices[n.after[v]].pos;
    a.share = r[0].x, distance[p] = r[1].x;
    a.normal = b.world({r[2].x, r[3].x, r[4].x});
    a.arm = from - b.pos + (to - from) * a.share;
    a.wanted = wanted(p);
    const R x = cross(a.arm, a.normal);
    a.turning = length(dot(x, b.turned(x))), a.sliding = length(b.agile * dot(a.arm, a.arm));
  }
  static L length(const L& squared) {
    const auto there = squared > T(0);
    return there ? root<T>(there ? squared : L{} + T(1)) : L{};
  }

  // By how much a point has to part at least; see coulomb.py.
  L overlap(int p) const { return edges[edge(p)].radius - distance[p]; }
  L deep(int p) const { return overlap(p) - T(0.1) * edges[edge(p)].radius; }
  L simple(int p) const {
    const L over = overlap(p), more = deep(p), rest = T(1 - n.recovery) * (more > T(0) ? more : L{});
    return over < T(0) ? over : T(n.recovery) * over + rest;
  }
  L approach(int p) const { return -dot(points[p].normal, apart(p, vel, spin)); }
  L rebound(int p) const {
    const L fast = approach(p), along = dot(points[p].normal, apart(p, change, motion));
    const auto hits = (edges[edge(p)].real > T(0)) & (along < simple(p)) & (fast > T(n.slowest));
    return hits ? bodies[body(p)].restitution * fast * T(n.dt) : L{};
  }
  L wanted(int p) const {
    const L by = simple(p), back = rebound(p);
    return (back > T(0)) & (back > by) ? back : by;
  }

  // Adds the derivative by ropes and by the point's body of what depends on a point as `to.points[p]` says.
  void place_back(int p, Inputs<T>& to, Solid<T>& db, Shifts& dvel, Wrench<T>& dspin) {
    const int f = p / n.vertices, v = edge(p), w = n.after[v], k = body(p);
    const Solid<T>& b = bodies[k];
    const Point<T>& a = points[p];
    Point<T>& d = to.points[p];
    const L zero{}, one = zero + T(1);
    const R x = cross(a.arm, a.normal), turned = b.turned(x);
    const L by_turning = a.turning > T(0) ? d.turning / (a.turning > T(0) ? a.turning : one) : zero;
    const L by_sliding = a.sliding > T(0) ? d.sliding / (a.sliding > T(0) ? a.sliding : one) : zero;
    db.add_turned(x * (T(0.5) * by_turning), x);
    const R dx = turned * by_turning;
    d.arm += cross(a.normal, dx) + a.arm * (by_sliding * b.agile);
    d.normal += cross(dx, a.arm);
    db.agile += T(0.5) * by_sliding * dot(a.arm, a.arm);
    const L back = rebound(p);
    const auto bounces = (back > T(0)) & (back > simple(p));
    const L bounced = bounces ? d.wanted * T(n.dt) : zero, kept = bounces ? zero : d.wanted;
    db.restitution += bounced * approach(p);
    exert(p, -bounced * b.restitution, R{}, dvel, dspin);
    tilt(p, -bounced * b.restitution, R{}, vel, spin, to);
    const L more = deep(p) > T(0) ? kept * T(1 - n.recovery) : zero;
    const L dover = overlap(p) < T(0) ? kept : kept * T(n.recovery) + more;
    to.edges[v].radius += dover - (overlap(p) < T(0) ? zero : T(0.1) * more);
    const R way = vertices[w].pos - vertices[v].pos, from = vertices[v].pos - b.pos;
    d.share += dot(d.arm, way);
    const R normal = b.local(d.normal), local = b.local(a.normal);
    db.add_world(d.normal, local);
    R dway = d.arm * a.share, dfrom = d.arm;
    const Line<T, 10> line = this->template line<10>(p);
    Num<T, 10> r[5];
    end<T, 10>(line, searched[p] ? &found[p] : nullptr, share(f), r);
    L g[10];
    for (int i = 0; i < 10; ++i)
      g[i] = d.share * r[0].g[i] - dover * r[1].g[i] + normal.x * r[2].g[i] + normal.y * r[3].g[i] + normal.z * r[4].g[i];
    const R start = {g[0], g[1], g[2]}, along = {g[3], g[4], g[5]};
    for (int i = 0; i < 4; ++i) db.numbers[i] += g[6 + i];
    db.offset += start;
    db.add_world(from, start), db.add_world(way, along);
    dfrom += b.world(start), dway += b.world(along);
    ADD(to.vertices[v].pos, dfrom - dway), ADD(to.vertices[w].pos, dway);
    db.pos -= dfrom;
  }
};
