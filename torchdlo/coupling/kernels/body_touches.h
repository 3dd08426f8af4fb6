// Pairs of bodies, the points at which they are nearest, and the derivative of these by the bodies.
#pragma once
#include "body_balls.h"

template <typename T>
struct Pairs {
  typedef Lanes<T> L;
  typedef Num<T, 0> P;
  typedef Num<T, TAPED> R;
  typedef Three<T, 0> V;
  static constexpr int FIELDS = sizeof(Touch<T, 0>) / sizeof(P), ALL = sizeof(Member<T, 0>) / sizeof(P), PLACE = 18;
  const L zero{}, one = zero + T(1);
  Sizes n;
  List<Candidate> candidates;
  List<int> start, first, owner;  // candidates and contacts of each pair; pair of each contact
  List<Member<T, 0>> bodies;
  List<char> active;  // pairs that may touch
  List<Found<T>> found;
  List<Touch<T, 0>> touches, contacts;
  List<L> chosen;  // candidate of each contact, within its pair

  explicit Pairs(const Sizes& n) : n(n), bodies(n.bodies), active(n.pairs) {
    for (int p = 0; p < n.pairs; ++p) {
      start.push_back(int(candidates.size())), first.push_back(int(owner.size()));
      const int a = int(n.pair[2 * p]), b = int(n.pair[2 * p + 1]);
      const bool forth = n.shape[b] == PLANE || n.shape[a] == SPHERE;
      const bool back = !forth && (n.shape[a] == PLANE || n.shape[b] == SPHERE);
      if (!back) add(a, b);
      if (!forth) add(b, a);
      const int count = int(candidates.size()) - start[p];
      owner.insert(owner.end(), count < n.points ? count : n.points, p);
    }
    start.push_back(int(candidates.size())), first.push_back(int(owner.size()));
    found.resize(candidates.size()), touches.resize(candidates.size());
    chosen.resize(owner.size()), contacts.resize(owner.size());
  }
  void add(int a, int b) {
    for (int kind : {STANDING, CIRCLE, SEGMENT})
      if (kind != SEGMENT || n.shape[b] != PLANE)
        for (int k = 0; k < n.how_many(kind, a); ++k) candidates.push_back({a, b, kind, k});
  }

  // A radius about the centre of mass that a body does not exceed.
  L extent(int k) const {
    const P* s = bodies[k].numbers;
    switch (n.shape[k]) {
      case SPHERE: return s[0].x;
      case BOX:
      case MESH: return s[0].x + s[1].x + s[2].x;
      case RING: return T(2) * (s[0].x + s[1].x);
      default: return s[0].x + s[1].x;
    }
  }
  // Whether two bodies may touch in some scene, if they move twice as far as foreseen.
  bool close(int p) const {
    const int a = int(n.pair[2 * p]), b = int(n.pair[2 * p + 1]);
    const auto size = [](const V& x) { return root<T>(dot(x, x).x); };
    const V between = bodies[a].pos - bodies[b].pos;
    L reach = zero + T(n.slowest * n.dt), gap = size(between);
    for (int k : {a, b}) {
      if (n.shape[k] == PLANE)
        gap = dot(bodies[k].axes[2], k == a ? between * P(T(-1)) : between).x;
      else
        reach += extent(k);
    }
    for (int k : {a, b}) {
      const L arm = n.shape[k] == PLANE ? size(between) + reach : extent(k);
      reach += T(2) * (size(bodies[k].change) + size(bodies[k].turn) * arm);
    }
    return any(~(gap > reach));  // what is not a number shall be seen
  }

  void choose(int p) {
    const int from = start[p], count = start[p + 1] - from, size = first[p + 1] - first[p];
    List<L> rank(count), far(count, zero);
    for (int c = 0; c < count; ++c) {
      const Candidate& each = candidates[from + c];
      P late;
      touches[from + c] = touch<T, 0>(each, bodies[each.first], bodies[each.second], n, found[from + c], late);
      Touch<T, 0>& t = touches[from + c];
      if (each.first != n.pair[2 * p]) t.normal = t.normal * P(T(-1));
      rank[c] = t.gap.x + late.x;
    }
    for (int k = 0; k < size; ++k) {
      L best = zero + T(size < count ? 0 : k), value = rank[0] - T(SPREAD) * far[0];
      for (int c = 1; size < count && c < count; ++c) {
        const L v = rank[c] - T(SPREAD) * far[c];
        const auto better = v < value;
        value = better ? v : value, best = better ? zero + T(c) : best;
      }
      Touch<T, 0>& to = contacts[first[p] + k];
      chosen[first[p] + k] = best;
      for (int c = 0; c < count; ++c) {
        const auto here = best == T(c);
        if (!any(here)) continue;
        for (int f = 0; f < FIELDS; ++f) {
          L& x = ((P*)&to)[f].x;
          x = here ? ((const P*)&touches[from + c])[f].x : x;
        }
      }
      for (int c = 0; size < count && c < count; ++c) {
        const V away = touches[from + c].point - to.point;
        const L d = root<T>(dot(away, away).x);
        far[c] = k == 0 || any(d < far[c]) ? (k == 0 ? d : d < far[c] ? d : far[c]) : far[c];
        rank[c] = best == T(c) ? zero + T(INFINITY) : rank[c];
      }
    }
  }

  // Adds the derivative of a candidate by its bodies, from those of the contacts that it was chosen for.
  void place_back(int p, int candidate, const List<Touch<T, 0>>& part, List<Member<T, 0>>& to) {
    const Candidate& each = candidates[candidate];
    L by[FIELDS] = {};
    bool used = false;
    for (int c = first[p]; c < first[p + 1]; ++c) {
      const auto here = chosen[c] == T(candidate - start[p]);
      if (!any(here)) continue;
      for (int i = 0; i < FIELDS; ++i) by[i] += here ? ((const P*)&part[c])[i].x : zero;
    }
    for (int i = 0; i < FIELDS; ++i) used = used || any(~(by[i] == T(0)));
    if (!used) return;
    Tape<T>& tape = Tape<T>::on();
    tape.nodes.clear();
    Member<T, TAPED> one, other;
    remember<PLACE>(bodies[each.first], one), remember<PLACE>(bodies[each.second], other);
    R late;
    Touch<T, TAPED> t = touch<T, TAPED>(each, one, other, n, found[candidate], late);
    if (each.first != n.pair[2 * p]) t.normal = t.normal * R(T(-1));
    tape.begin();
    for (int i = 0; i < FIELDS; ++i) ((R*)&t)[i].give(by[i]);
    tape.back(int(tape.nodes.size()), 0);
    collect<PLACE>(one, to[each.first]), collect<PLACE>(other, to[each.second]);
  }
  template <int COUNT, class From, class To>
  static void remember(const From& from, To& to) {
    for (int i = 0; i < COUNT; ++i) ((R*)&to)[i] = R::variable(((const P*)&from)[i].x, 0);
  }
  template <int COUNT, class From, class To>
  static void collect(const From& from, To& to) {
    for (int i = 0; i < COUNT; ++i) ((P*)&to)[i].x += ((const R*)&from)[i].by();
  }
};
