// Geometry and loads of rods, for `lanes.py`, several scenes per instruction.
//
// The formulas stand in rod.py, effects/elastic.py, rotation.py, integrate.py and constrain.py, as tensor operations.
// Each kernel reads the components of its inputs in the order of the fields of `In`, and numbers those of its results.
#include "rods.h"

#include "balance.h"

namespace {

template <typename T>
Vec<T> transport(const Vec<T>& x, const Vec<T>& start, const Vec<T>& end) {
  const Vec<T> axis = cross(start, end), once = cross(axis, x);
  return x + once + cross(axis, once) * (T(1) / at_least<T>(dot(start, end) + T(1), T(1e-6)));
}

template <typename T>
struct Look {  // rod.view: lengths, tangents, tangents before, lengths of hinges
  struct In {
    Vec<T> pos;
    Lanes<T> rest, share, mask;
  };
  Look(const Call&, const Scratch<T>&) {}
  void operator()(const In* slot, const Out<T>& out) {
    for (int64_t i = 0; i < out.call.slots; ++i) {
      const int64_t n = out.call.after[i];
      const Vec<T> e = edge(slot[i].pos, slot[n].pos, slot[i].mask);
      const Lanes<T> size = at_least<T>(length(e), T(1e-12));
      const Vec<T> tangent = e * (T(1) / size);
      out.put(0, i, size);
      out.put(1, i, tangent);
      out.put(4, n, tangent);
      out.put(7, n, (slot[n].rest + slot[i].rest) * T(0.5) * slot[n].share);
    }
  }
};

template <typename T>
struct Carry {  // rod.advance_frames: directors, sine and cosine of the angle across hinges
  struct In {
    Vec<T> director, tangent, pos;
    Lanes<T> mask;
  };
  struct Now {
    Vec<T> director, tangent;
  };
  Carry(const Call&, const Scratch<T>& free) : room(free) {}
  void operator()(const In* slot, const Out<T>& out) {
    Scratch<T> scratch = room;
    Now* now = scratch.template take<Now>(out.call.slots);
    for (int64_t i = 0; i < out.call.slots; ++i) {
      const Vec<T> e = edge(slot[i].pos, slot[out.call.after[i]].pos, slot[i].mask);
      const Vec<T> tangent = e * (T(1) / at_least<T>(length(e), T(1e-12)));
      Vec<T> director = transport(slot[i].director, slot[i].tangent, tangent);
      director -= tangent * dot(tangent, director);
      const Lanes<T> whole = length(director);
      now[i] = {director * (T(1) / (whole == T(0) ? Lanes<T>{} + T(1) : whole)), tangent};
      out.put(0, i, now[i].director);
    }
    for (int64_t i = 0; i < out.call.slots; ++i) {
      const Now& next = now[out.call.after[i]];
      const Vec<T> carried = transport(now[i].director, now[i].tangent, next.tangent);
      out.put(3, out.call.after[i], dot(cross(carried, next.director), next.tangent));
      out.put(4, out.call.after[i], dot(carried, next.director));
    }
  }
  const Scratch<T>& room;
};

template <typename T>
struct Bend {  // elastic.Bend.loads: gradient, stiffness of hinges
  struct In {
    Vec<T> before, tangent;
    Lanes<T> length, hinge, bend, mask;
  };
  Bend(const Call&, const Scratch<T>& free) : room(free) {}
  void operator()(const In* slot, const Out<T>& out) {
    Scratch<T> scratch = room;
    Vec<T>* back = scratch.template take<Vec<T>>(out.call.slots);
    Vec<T>* gradient = scratch.template take<Vec<T>>(out.call.slots);
    for (int64_t i = 0; i < out.call.slots; ++i) {
      const In& p = slot[i];
      const Lanes<T> cosine = dot(p.before, p.tangent), chi = at_least<T>(cosine + T(1), T(1e-6));
      const Lanes<T> stiffness = p.bend / p.hinge * p.mask, slope = T(-4) * stiffness / (chi * chi);
      gradient[i] = (p.before - p.tangent * cosine) * (slope / p.length);
      back[i] = (p.tangent - p.before * cosine) * slope;
      const Lanes<T> steep = (T(1) - cosine) / chi, s = steep > T(100) ? Lanes<T>{} + T(100) : steep;
      out.put(3, i, stiffness * (T(1) + s) * (T(1) + T(3) * s));
    }
    for (int64_t i = 0; i < out.call.slots; ++i)
      out.put(0, i, gradient[i] + back[out.call.after[i]] * (T(1) / slot[i].length));
  }
  const Scratch<T>& room;
};

template <typename T>
struct Twist {  // elastic.Twist.loads: gradient, torque, second derivatives
  struct In {
    Vec<T> before, tangent;
    Lanes<T> length, hinge, twist, mask, angle, reference, rest;
  };
  Twist(const Call&, const Scratch<T>& free) : room(free) {}
  void operator()(const In* slot, const Out<T>& out) {
    Scratch<T> scratch = room;
    Vec<T>* pull = scratch.template take<Vec<T>>(out.call.slots);
    Lanes<T>* moment = scratch.take(out.call.slots);
    for (int64_t k = 0; k < out.call.slots; ++k) {
      const int64_t i = out.call.after[k];
      const In& p = slot[i];
      const Lanes<T> stiffness = p.twist / p.hinge * p.mask;
      moment[i] = stiffness * ((p.angle - slot[k].angle + p.reference - p.rest) * p.mask);
      const Lanes<T> chi = at_least<T>(dot(p.before, p.tangent) + T(1), T(1e-6));
      pull[i] = cross(p.before, p.tangent) * (p.mask / chi * moment[i]);
      out.put(4, i, stiffness);
      out.put(5, i, -stiffness);
      out.put(6, i, stiffness);
    }
    for (int64_t i = 0; i < out.call.slots; ++i) {
      const int64_t n = out.call.after[i];
      out.put(0, i, (pull[i] + pull[n]) * (T(1) / slot[i].length));
      out.put(3, i, moment[n] - moment[i]);
    }
  }
  const Scratch<T>& room;
};

template <typename T>
struct Curve {  // elastic.curvature: kappa, binormal, three means, four derivatives by twists
  struct In {
    Vec<T> before, tangent, director;
    Lanes<T> cosine, sine, mask;
  };
  Curve(const Call&, const Scratch<T>& free) : room(free) {}
  void operator()(const In* slot, const Out<T>& out) {
    struct Frame {
      Vec<T> m1, m2;
    };
    Scratch<T> scratch = room;
    Frame* frame = scratch.template take<Frame>(out.call.slots);
    for (int64_t i = 0; i < out.call.slots; ++i) {
      const In& p = slot[i];
      const Vec<T> v = cross(p.tangent, p.director);
      frame[i] = {p.director * p.cosine + v * p.sine, v * p.cosine - p.director * p.sine};
    }
    for (int64_t k = 0; k < out.call.slots; ++k) {
      const int64_t i = out.call.after[k];
      const In& p = slot[i];
      const Frame &old = frame[k], &own = frame[i];
      const Lanes<T> chi = at_least<T>(dot(p.before, p.tangent) + T(1), T(1e-6)), inverse = T(1) / chi;
      const Vec<T> kb = cross(p.before, p.tangent) * (T(2) * inverse * p.mask);
      const Vec<T> mean1 = (old.m1 + own.m1) * inverse, mean2 = (old.m2 + own.m2) * inverse;
      out.put(0, i, dot(kb, mean2) * chi * T(0.5));
      out.put(1, i, -dot(kb, mean1) * chi * T(0.5));
      out.put(2, i, kb);
      out.put(5, i, (p.before + p.tangent) * inverse);
      out.put(8, i, mean1);
      out.put(11, i, mean2);
      out.put(14, i, dot(kb, old.m1) * T(-0.5));
      out.put(15, i, dot(kb, old.m2) * T(-0.5));
      out.put(16, i, dot(kb, own.m1) * T(-0.5));
      out.put(17, i, dot(kb, own.m2) * T(-0.5));
    }
  }
  const Scratch<T>& room;
};

template <typename T>
struct Pull {  // elastic.Curvature.pull_back: gradient, torque
  struct In {
    Lanes<T> kappa1, kappa2;
    Vec<T> mean, mean1, mean2;
    Lanes<T> b1, b2, a1, a2;
    Vec<T> before, tangent;
    Lanes<T> length, f1, f2;
  };
  Pull(const Call&, const Scratch<T>& free) : room(free) {}
  void operator()(const In* slot, const Out<T>& out) {
    struct Part {
      Vec<T> after, back;
      Lanes<T> torque;
    };
    Scratch<T> scratch = room;
    Part* part = scratch.template take<Part>(out.call.slots);
    for (int64_t i = 0; i < out.call.slots; ++i) {
      const In& p = slot[i];
      const Vec<T> turned = p.mean2 * p.f1 - p.mean1 * p.f2;
      const Vec<T> along = p.mean * -(p.f1 * p.kappa1 + p.f2 * p.kappa2);
      part[i] = {along - cross(p.before, turned), along + cross(p.tangent, turned), p.f1 * p.b1 + p.f2 * p.b2};
    }
    for (int64_t i = 0; i < out.call.slots; ++i) {
      const In& p = slot[i];
      const Part& next = part[out.call.after[i]];
      out.put(0, i, (part[i].after + next.back) * (T(1) / p.length));
      out.put(3, i, -(p.f1 * p.a1 + p.f2 * p.a2) - next.torque);
    }
  }
  const Scratch<T>& room;
};

template <typename T>
struct Answer {  // elastic.answers: second derivatives by twists, and what moments add to them
  struct In {
    Lanes<T> b1, b2, a1, a2, f1, f2, s1, s2, coupling;
  };
  Answer(const Call&, const Scratch<T>&) {}
  void operator()(const In* slot, const Out<T>& out) {
    for (int64_t i = 0; i < out.call.slots; ++i) {
      const In& p = slot[i];
      const auto product = [&](const Lanes<T>& x1, const Lanes<T>& x2, const Lanes<T>& y1, const Lanes<T>& y2) {
        return p.s1 * x1 * y1 + p.s2 * x2 * y2 + p.coupling * (x1 * y2 + x2 * y1);
      };
      out.put(0, i, product(p.b1, p.b2, p.b1, p.b2));
      out.put(1, i, product(p.b1, p.b2, p.a1, p.a2));
      out.put(2, i, product(p.a1, p.a2, p.a1, p.a2));
      out.put(3, i, p.f1 * p.b2 - p.f2 * p.b1);
      out.put(4, i, p.f1 * p.a2 - p.f2 * p.a1);
    }
  }
};

template <typename T>
struct Damp {  // material.BendingDamping: rates of curvature, how moments in proportion to them answer to twists
  struct In {
    Lanes<T> kappa1, kappa2;
    Vec<T> binormal, mean, mean1, mean2;
    Lanes<T> b1, b2, a1, a2;
    Vec<T> before, tangent, director;
    Lanes<T> cosine, sine;
    Vec<T> vel;
    Lanes<T> spin, length, mask, resistance;
  };
  Damp(const Call&, const Scratch<T>& free) : room(free) {}
  void operator()(const In* slot, const Out<T>& out) {
    struct Edge {
      Vec<T> m1, m2, turning;
    };
    Scratch<T> scratch = room;
    Edge* edges = scratch.template take<Edge>(out.call.slots);
    const T often = T(out.call.numbers[0]);
    for (int64_t i = 0; i < out.call.slots; ++i) {
      const In& p = slot[i];
      const Vec<T> v = cross(p.tangent, p.director);
      edges[i] = {p.director * p.cosine + v * p.sine, v * p.cosine - p.director * p.sine,
                  (slot[out.call.after[i]].vel - p.vel) * (p.mask / p.length)};
    }
    for (int64_t k = 0; k < out.call.slots; ++k) {
      const int64_t i = out.call.after[k];
      const In& p = slot[i];
      const Edge &old = edges[k], &own = edges[i];
      const Lanes<T> back = slot[k].spin;
      const Vec<T> swept = cross(old.turning, p.tangent) - cross(own.turning, p.before);
      const Lanes<T> stretched = dot(p.mean, old.turning + own.turning);
      const Lanes<T> rate1 = dot(p.mean2, swept) - p.kappa1 * stretched + p.b1 * back + p.a1 * p.spin;
      const Lanes<T> rate2 = -dot(p.mean1, swept) - p.kappa2 * stretched + p.b2 * back + p.a2 * p.spin;
      const Lanes<T> chi = at_least<T>(dot(p.before, p.tangent) + T(1), T(1e-6));
      const Vec<T> moved = swept * (T(2) / chi) - p.binormal * stretched;
      const Lanes<T> grown_b1 = T(-0.5) * dot(moved, old.m1) + back * p.b2;
      const Lanes<T> grown_b2 = T(-0.5) * dot(moved, old.m2) - back * p.b1;
      const Lanes<T> grown_a1 = T(-0.5) * dot(moved, own.m1) + p.spin * p.a2;
      const Lanes<T> grown_a2 = T(-0.5) * dot(moved, own.m2) - p.spin * p.a1;
      const Lanes<T> onward = p.b1 * grown_a1 + p.b2 * grown_a2, backward = p.a1 * grown_b1 + p.a2 * grown_b2;
      const Lanes<T> own_b = p.b1 * grown_b1 + p.b2 * grown_b2, own_a = p.a1 * grown_a1 + p.a2 * grown_a2;
      out.put(0, i, rate1);
      out.put(1, i, rate2);
      out.put(2, i, p.resistance * ((p.b1 * p.b1 + p.b2 * p.b2) * often + own_b));
      out.put(3, i, p.resistance * ((p.a1 * p.b1 + p.a2 * p.b2) * often + T(0.5) * (onward + backward)));
      out.put(4, i, p.resistance * ((p.a1 * p.a1 + p.a2 * p.a2) * often + own_a));
      out.put(5, i, T(0.5) * p.resistance * (onward - backward));
      out.put(6, i, p.resistance * (rate1 * p.b2 - rate2 * p.b1));
      out.put(7, i, p.resistance * (rate1 * p.a2 - rate2 * p.a1));
    }
  }
  const Scratch<T>& room;
};

template <typename T>
struct Joint {  // grid._Joint: what the angles of a joint are angles of, and the sine of the second
  struct In {
    Lanes<T> k1, k2, twist, c, s, w;
    Lanes<T> p() const { return T(-0.5) * w * k1; }
    Lanes<T> q() const { return T(-0.5) * w * k2; }
    Lanes<T> nx() const { return T(2) * (c * s - p() * q()); }
    Lanes<T> dx() const { return c * c - s * s + q() * q() - p() * p(); }
    Lanes<T> y() const { return T(2) * (s * q() + c * p()); }
    Lanes<T> nz() const { return T(2) * (c * q() - s * p()); }
    Lanes<T> dz() const { return T(1) - p() * p() - q() * q(); }
    Lanes<T> norm() const { return T(1) + p() * p() + q() * q(); }
    Lanes<T> sine() const {
      const Lanes<T> x = y() / norm(), most = Lanes<T>{} + T(0.99);
      return x > most ? most : x < -most ? -most : x;
    }
  };
  Joint(const Call&, const Scratch<T>&) {}
  void operator()(const In* slot, const Out<T>& out) {
    for (int64_t i = 0; i < out.call.slots; ++i) {
      out.put(0, i, slot[i].nx());
      out.put(1, i, slot[i].dx());
      out.put(2, i, slot[i].nz());
      out.put(3, i, slot[i].dz());
      out.put(4, i, slot[i].sine());
    }
  }
};

template <typename T>
struct Spring {  // grid._Joint.answers: moments, second derivatives by twists, and what moments add to them
  struct In {
    typename Joint<T>::In joint;
    Lanes<T> bending, twisting, some, links, b1, b2, a1, a2, x, y, z;
  };
  Spring(const Call&, const Scratch<T>&) {}
  void operator()(const In* slot, const Out<T>& out) {
    for (int64_t i = 0; i < out.call.slots; ++i) {
      const In& h = slot[i];
      const auto& j = h.joint;
      const Lanes<T> p = j.p(), q = j.q(), c = j.c, s = j.s, nx = j.nx(), dx = j.dx(), nz = j.nz(), dz = j.dz();
      const Lanes<T> sine = j.sine();
      const Lanes<T> ex = h.twisting * h.x / (nx * nx + dx * dx), ez = h.bending * h.z / (nz * nz + dz * dz);
      const Lanes<T> ey = h.bending * h.y / (j.norm() * root<T>(T(1) - sine * sine));
      const Lanes<T> by_p = ex * T(2) * (p * nx - q * dx) + ez * T(2) * (p * nz - s * dz) + ey * T(2) * (c - p * sine);
      const Lanes<T> by_q = ex * T(-2) * (p * dx + q * nx) + ez * T(2) * (c * dz + q * nz) + ey * T(2) * (s - q * sine);
      const Lanes<T> turned = (c * c - s * s) * dx + T(2) * c * s * nx;
      const Lanes<T> by_t = ex * turned - T(0.5) * ez * j.y() * dz + T(0.5) * ey * nz;
      const auto on = h.some > T(0);
      const Lanes<T> none{}, moment = on ? by_t / j.w - h.twisting * j.twist : none;
      out.put(0, i, on ? -by_p / (T(2) * j.w) - h.bending * j.k1 : none);
      out.put(1, i, on ? -by_q / (T(2) * j.w) - h.bending * j.k2 : none);
      out.put(2, i, moment);
      const Lanes<T> share = T(-0.5) * h.links, f = share * (h.twisting * j.twist + moment);
      const Lanes<T> before = share * (j.k2 * h.b1 + j.k1 * h.b2), after = share * (j.k2 * h.a1 + j.k1 * h.a2);
      out.put(3, i, h.twisting * (before * before - T(2) * before) + f * T(2) * h.b1 * h.b2);
      out.put(4, i, h.twisting * (before - after + before * after) + f * (h.b1 * h.a2 + h.b2 * h.a1));
      out.put(5, i, h.twisting * (after * after + T(2) * after) + f * T(2) * h.a1 * h.a2);
      out.put(6, i, f * (j.k2 * h.b2 - j.k1 * h.b1));
      out.put(7, i, f * (j.k2 * h.a2 - j.k1 * h.a1));
    }
  }
};

template <typename T>
struct Settle {  // integrate.settle_twist: one step of Newton's method, and the torques that it leaves
  struct In {
    Lanes<T> free, before, across, own, torque, geometry, geometry_own, skew;
  };
  Settle(const Call& call, const Scratch<T>& free) : room(free), prior(preceding(call)) {}
  void operator()(const In* slot, const Out<T>& out) {
    const Call& s = out.call;
    const int64_t v = s.slots;
    Scratch<T> scratch = room;
    Lanes<T> *same = scratch.take(v), *onward = scratch.take(v), *back = scratch.take(v), *entries = scratch.take(3 * v),
             *rhs = scratch.take(v), *change = scratch.take(v), *space = scratch.take((v + s.half) * (2 * s.half + 2));
    Lanes<T> most{};
    for (int64_t i = 0; i < v; ++i) {
      const In &p = slot[i], &next = slot[s.after[i]];
      same[i] = p.own + next.before + p.geometry_own + next.geometry;
      onward[i] = next.across + next.skew;
      most = i == 0 || same[i] > most ? same[i] : most;
    }
    for (int64_t i = 0; i < v; ++i) {
      const In& p = slot[i];
      same[i] += T(1e-9) * most;
      back[i] = slot[i].across - p.skew;
      entries[i] = p.free * same[i] + (T(1) - p.free);
      entries[v + i] = p.free * onward[i];
      entries[2 * v + i] = p.free * back[i];
      rhs[i] = p.torque * p.free;
    }
    const T *e = (const T*)entries, *r = (const T*)rhs;
    constexpr int W = WIDTH<T>;
    const auto solve = s.half == 1 ? solve_lanes<T, Lanes<T>, 1> : solve_lanes<T, Lanes<T>, 0>;
    solve(e, s.pattern, (int)s.count, s.order, r, (T*)change, (int)v, (int)s.half, W, 0, W, space);
    for (int64_t i = 0; i < v; ++i) {
      out.put(0, i, change[i]);
      out.put(1, i, slot[i].torque - same[i] * change[i] - onward[i] * change[s.after[i]] - back[i] * change[prior[i]]);
    }
  }
  const Scratch<T>& room;
  const std::vector<int64_t> prior;
};

template <typename T>
struct Project {  // edge_lengths.project: positions and tensions by Newton's method
  struct In {
    Lanes<T> rest, compliance, active, mask, give, tension;
    Vec<T> moved, answer, along;
  };
  Project(const Call& call, const Scratch<T>& free) : room(free), prior(preceding(call)) {}
  void operator()(const In* slot, const Out<T>& out) {
    const Call& s = out.call;
    const int64_t v = s.slots;
    const T most = T(s.numbers[0]), least = T(s.numbers[1]), stiff = T(1 + s.numbers[2]);
    Scratch<T> scratch = room;
    Lanes<T> *tension = scratch.take(v), *entries = scratch.take(3 * v), *rhs = scratch.take(v),
             *change = scratch.take(v), *space = scratch.take((v + s.half) * (2 * s.half + 2));
    Vec<T>*pull = scratch.template take<Vec<T>>(v), *pos = scratch.template take<Vec<T>>(v);
    const Lanes<T> zero{};
    const auto place = [&] {
      for (int64_t i = 0; i < v; ++i) pull[i] = slot[i].along * tension[i];
      for (int64_t i = 0; i < v; ++i) pos[i] = slot[i].moved + times(slot[i].answer, pull[i] - pull[prior[i]]);
    };
    for (int64_t i = 0; i < v; ++i) {
      const In& p = slot[i];
      // A straight rope pressed along its line leaves tensions of any size: no first guess.
      tension[i] = (p.tension < -least * p.rest / p.give ? zero : p.tension) * p.active;
    }
    const auto solve = s.half == 1 ? solve_lanes<T, Lanes<T>, 1> : solve_lanes<T, Lanes<T>, 0>;
    for (int64_t k = 0; k <= s.numbers[3]; ++k) {
      place();
      for (int64_t i = 0; i < v; ++i) {
        const In &p = slot[i], &next = slot[s.after[i]], &last = slot[prior[i]];
        const Vec<T> e = edge(pos[i], pos[s.after[i]], p.mask);
        const Lanes<T> size = length(e), beyond = tension[i] - most * p.rest / p.give;
        const Vec<T> end = e * (T(1) / at_least<T>(size, T(1e-12)));
        const auto yields = beyond > T(0);
        const Lanes<T> soft = p.compliance + (yields ? p.give : zero);
        rhs[i] = (size - p.rest - p.compliance * tension[i] - p.give * (yields ? beyond : zero)) * p.active;
        entries[i] = p.active * (stiff * dot(times(end, p.along), p.answer + next.answer) + soft) + (T(1) - p.active);
        entries[v + i] = -p.active * dot(end, times(next.along, next.answer));
        entries[2 * v + i] = -p.active * dot(times(end, p.answer), last.along);
      }
      solve((const T*)entries, s.pattern, (int)s.count, s.order, (const T*)rhs, (T*)change, (int)v, (int)s.half,
            WIDTH<T>, 0, WIDTH<T>, space);
      for (int64_t i = 0; i < v; ++i) tension[i] += change[i];
    }
    place();
    for (int64_t i = 0; i < v; ++i) {
      out.put(0, i, pos[i]);
      out.put(3, i, tension[i]);
    }
  }
  static Vec<T> times(const Vec<T>& a, const Vec<T>& b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
  const Scratch<T>& room;
  const std::vector<int64_t> prior;
};

}  // namespace

#define KERNEL(NAME, KIND, T)                                                                            \
  extern "C" void NAME##_##T(const T* const* from, T* to, const Call* call, int threads) {               \
    blocks<T, KIND<T>>(from, to, *call, threads);                                                        \
  }
#define KERNELS(NAME, KIND) \
  KERNEL(NAME, KIND, float) \
  KERNEL(NAME, KIND, double)

KERNELS(look, Look)
KERNELS(carry, Carry)
KERNELS(bend, Bend)
KERNELS(twist, Twist)
KERNELS(curve, Curve)
KERNELS(pull, Pull)
KERNELS(answer, Answer)
KERNELS(damp, Damp)
KERNELS(joint, Joint)
KERNELS(spring, Spring)
KERNELS(settle, Settle)
KERNELS(balance, Balance)
KERNELS(project, Project)
