// Contacts of bodies: how their points move, what forces on them exert, and the law of the forces; see body_contact.py.
#pragma once
#include "body_touches.h"

template <typename T>
struct Sets {  // which contacts press and how they rub
  Lanes<T> press, slides, drag;
  Three<T, 0> slip;
};
template <typename T, int N>
struct Link {
  int a, b;
  Three<T, N> normal, arms[2], free;
  Num<T, N> wanted, mu_s, mu_k;
};
template <typename T, int N>
struct Wrench {
  Three<T, N> force, torque;
};

template <typename T>
struct Linked : Pairs<T> {
  typedef Lanes<T> L;
  typedef Num<T, 0> P;
  using Pairs<T>::n, Pairs<T>::owner, Pairs<T>::active;
  List<L> stiff;
  List<Sets<T>> sets;
  using Pairs<T>::Pairs;

  template <int N>
  static Num<T, N> combined(const Num<T, N>& a, const Num<T, N>& b) {
    const Num<T, N> both = a + b, one(T(1));
    return Num<T, N>(T(2)) * a * b / select(both.x > T(0), both, one);
  }

  template <int N>
  using Bodies = List<Member<T, N>>;
  template <int N>
  using Wrenches = List<Wrench<T, N>>;

  // How a contact's points move against each other, if bodies move like that.
  template <int N>
  static Three<T, N> seen(const Link<T, N>& l, const Wrenches<N>& m) {
    return m[l.a].force + cross(m[l.a].torque, l.arms[0]) - m[l.b].force - cross(m[l.b].torque, l.arms[1]);
  }
  // What forces on the first bodies of contacts exert.
  template <int N>
  Wrenches<N> exerted(const List<Link<T, N>>& links, const List<Three<T, N>>& forces) const {
    const Num<T, N> none(T(0));
    Wrenches<N> to(n.bodies, {{none, none, none}, {none, none, none}});
    for (size_t c = 0; c < links.size(); ++c) {
      if (!active[owner[c]]) continue;
      const Link<T, N>& l = links[c];
      to[l.a].force += forces[c], to[l.a].torque += cross(l.arms[0], forces[c]);
      to[l.b].force -= forces[c], to[l.b].torque -= cross(l.arms[1], forces[c]);
    }
    return to;
  }

  template <int N>
  List<Link<T, N>> link(const Bodies<N>& b, const List<Touch<T, N>>& contacts) const {
    typedef Num<T, N> S;
    const S none(T(0));
    List<Link<T, N>> links(owner.size());
    Wrenches<N> moves, speeds;
    for (const auto& k : b) moves.push_back({k.change, k.turn}), speeds.push_back({k.vel, k.omega});
    for (size_t c = 0; c < links.size(); ++c) {
      Link<T, N>& l = links[c];
      l.a = int(n.pair[2 * owner[c]]), l.b = int(n.pair[2 * owner[c] + 1]);
      if (!active[owner[c]]) continue;
      const Member<T, N>&one = b[l.a], &two = b[l.b];
      l.normal = contacts[c].normal;
      l.arms[0] = contacts[c].point - one.pos, l.arms[1] = contacts[c].point - two.pos;
      l.mu_s = combined(one.mu_s, two.mu_s), l.mu_k = combined(one.mu_k, two.mu_k);
      l.free = seen(l, moves);
      // By how much they have to part at least; see coulomb.py.
      const S gap = contacts[c].gap, overlap = larger(-gap, none), deep = larger(overlap - S(T(n.shallow)), none);
      const S shared = S(T(n.recovery)) * overlap + S(T(1 - n.recovery)) * deep;
      const S most(T(n.fastest * n.dt)), asked = larger(shared, none);
      const S simple = select(gap.x < T(0), asked * most / (asked + most), -gap);
      const S approach = -dot(l.normal, seen(l, speeds));
      const auto hits = (dot(l.normal, l.free).x < simple.x) & (approach.x > T(n.slowest));
      const S back = combined(one.restitution, two.restitution) * approach * S(T(n.dt));
      l.wanted = select(hits & (back.x > T(0)) & (back.x > simple.x), back, simple);
    }
    return links;
  }

  // Length [m] and direction of the part of a motion along the surface.
  template <int N>
  Num<T, N> slip(const Link<T, N>& l, int c, const Three<T, N>& moved, Three<T, N>& along) const {
    const Num<T, N> hard(stiff[c]);
    return measured((moved - l.normal * dot(l.normal, moved)) * hard, along) / hard;
  }

  template <int N>
  Three<T, N> force(const Link<T, N>& l, int c, const Three<T, N>& moved) const {
    typedef Num<T, N> S;
    const Sets<T>& s = sets[c];
    Three<T, N> along;
    const S size = slip(l, c, moved, along);
    const S load = positive(S(stiff[c] * s.press) * (l.wanted - dot(l.normal, moved)));
    const auto slides = s.slides > T(0);
    const S limit = select(slides, l.mu_k, l.mu_s) * load;
    // What sticks is held along its slip, not along the direction of that: bodies at rest have none.
    const auto sticks = ~slides & (s.drag * size.x <= limit.x);
    const Three<T, N> held = (moved - l.normal * dot(l.normal, moved)) * S(s.drag), rubs = along * limit;
    return l.normal * load - Three<T, N>{select(sticks, held.x, rubs.x), select(sticks, held.y, rubs.y),
                                         select(sticks, held.z, rubs.z)};
  }

  // The share of forces at which they do what is asked for; see `_fitting` in body_contact.py.
  template <int N>
  Num<T, N> fitting(const Bodies<N>& b, const List<Link<T, N>>& links, const List<Three<T, N>>& f) const {
    typedef Num<T, N> S;
    Wrenches<N> m = exerted(links, f);
    for (int k = 0; k < n.bodies; ++k) m[k] = {m[k].force * b[k].mobility, b[k].turned(m[k].torque)};
    S asked(T(0)), done(T(0)), unit(T(1));
    for (size_t c = 0; c < links.size(); ++c) {
      if (!active[owner[c]]) continue;
      asked = asked + dot(f[c], links[c].normal * links[c].wanted - links[c].free);
      done = done + dot(f[c], seen(links[c], m));
    }
    const auto none = done.x <= T(0);
    return select(none, unit, asked / select(none, unit, done));
  }
};
