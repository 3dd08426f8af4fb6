// One implicit substep of ropes that touch by Newton's method, one scene after the other, and its derivative.
//
// The formulas stand in contact_step.py, contact_penalty.py and edge_lengths.py, as tensor operations.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "flush.h"
#include "joint_points.h"

namespace {

struct Sizes {
  int64_t slots, scenes, families, bodies, pairs, half, tries;
  const int64_t *after, *of, *steps;  // next slots; body of each family of points or -1; Newton steps of each try
  const int32_t* order;
  const double *hardness, *law;  // law: turning, most, least, shift, dt, solved, round, far, leaving
  Tied tied;
};

// Where a number is among the inputs, and how far it is from slot to slot, family to family and scene to scene.
struct Place {
  int64_t input, offset, slot, family, scene;
};
// Numbers of slots, of points, of pairs, and of how bodies resist; where corners of pairs are told (4, pairs, scenes).
struct Inputs {
  const Place *slots, *points, *pairs, *bodies;
  int64_t joints;             // which input has the numbers of joints, (scenes, numbers), or -1
  int64_t corner[4], scenes;  // offset, and from corner to corner, pair to pair, scene to scene; what their numbers count
};

// Numbers of a vertex and its edge.
template <typename T>
struct Slot {
  T rest, compliance, active, mask, give, hinge, swing, free, tension;
  T vertex[3], moved[3], force[3], start[3], lead[3], scale, origin[3];
};
template <typename T>
struct Point {
  T real, share, normal[3], tangent[3], radius, lever, wanted, given[3], mu, arm[3];
};
template <typename T>
struct Pair {
  T real, normal[3], radius, wanted, mu, corner[4][9];
};

// How points move with the ends of edges and with bodies, see `maps` in contact_penalty.py.
template <typename T>
struct Maps {
  T first[9], second[9], body[18];

  explicit Maps(const Point<T>& p) {
    const T *n = p.normal, *t = p.tangent, *r = p.arm;
    const T nt = n[0] * t[0] + n[1] * t[1] + n[2] * t[2], held = p.lever > T(0) ? p.radius : T(0);
    const T arm[9] = {0, -r[2], r[1], r[2], 0, -r[0], -r[1], r[0], 0};
    const T turn[9] = {0, -n[2], n[1], n[2], 0, -n[0], -n[1], n[0], 0};
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b) {
        const T one = T(a == b), swing = p.lever * (t[a] * n[b] - nt * one);
        first[3 * a + b] = (1 - p.share) * one - swing;
        second[3 * a + b] = p.share * one + swing;
        T across = turn[3 * a + b];
        for (int c = 0; c < 3; ++c) across -= turn[3 * a + c] * t[c] * t[b];
        body[6 * a + b] = -one;
        body[6 * a + 3 + b] = arm[3 * a + b] - held * across;
      }
  }
};

template <typename T>
struct Felt {
  T force[3], gradient[9], steep;
};

template <typename T>
void times(const T* m, const T* x, T* y, int columns) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < columns; ++j) y[i] += m[columns * i + j] * x[j];
}
// y += m^T x
template <typename T>
void back(const T* m, const T* x, T* y, int columns) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < columns; ++j) y[j] += m[columns * i + j] * x[i];
}

template <typename T>
struct State {
  std::vector<T> pos, impulse, bodies, joints;
};

template <typename T>
class Scene {
 public:
  explicit Scene(const Sizes& sizes)
      : joints{sizes.tied, sizes.bodies}, s(sizes), v(s.slots), n(4 * v), k(s.half),
        own(6 * s.bodies + 3 * s.tied.count), before(v), rank(n), y(3 * v), begin(3 * v), along(3 * v),
        push(3 * v), pull(3 * v), turn(3 * v), resist(3 * v), touch(3 * v), between(3 * v), joined(3 * v), residual(3 * v),
        excess(v), lean(v), one(v), two(v), same(v), firm(v), least(v), wrench(6 * s.bodies), step(n),
        load_pos(3 * v), load_length(v), load_body(own), gap(3 * s.tied.count), known(s.families * v) {
    for (int64_t i = 0; i < v; ++i) before[s.after[i]] = i;
    for (int64_t j = 0; j < n; ++j) rank[s.order[j]] = j;
    const auto place = [&](int64_t row, int64_t column) { places.push_back(rank[row] * 2 * k + rank[column] + k); };
    for (int64_t i = 0; i < v; ++i) {
      const int64_t next = s.after[i], far = s.after[next], length = 3 * v + i;
      for (int64_t c = 0; c < 3; ++c) {
        const int64_t here = c * v + i, there = c * v + next, beyond = c * v + far;
        place(here, here), place(here, there), place(there, here), place(here, length), place(there, length);
        place(length, here), place(length, there), place(here, beyond), place(beyond, here);
      }
      place(length, length);
    }
  }

  const Slot<T>* slot;
  const Point<T>* points;
  const Pair<T>* pairs;
  const int64_t* corners;  // of pairs
  const T* inertia;        // how bodies resist displacements, 6 x 6 each
  Joints<T> joints;        // a scene with some has no derivative here

  struct Parts {  // derivatives by what the scene is made of
    Slot<T>* slots;
    Point<T>* points;
    Pair<T>* pairs;
    T* inertia;
  };

  // Adds the derivative of results by all that the scene is made of.
  //
  // The exact step from a state x makes x' = x - share K^-1 R(x), in which x and K are constant: held vertices are where
  // they have to be, and impulses are tensions times `scale`. Results depend on x' and on what the scene is made of.
  void backward(State<T>& at, T hard, const T* by_pos, const T* by_tension, const T* by_whole, const T* by_exerted,
                const T* by_held, Parts to) {
    prepare();
    harden(hard);
    by_firm.assign(v, T(0)), by_lean.assign(v, T(0));
    std::vector<T> tension(at.impulse), whole(3 * v), contact(3 * v), length(v), torque(6 * s.bodies);
    for (int64_t i = 0; i < v; ++i) {
      at.impulse[i] *= scale;
      for (int c = 0; c < 3; ++c)
        if (!(slot[i].free > T(0))) at.pos[3 * i + c] = slot[i].moved[c];
    }
    State<T> now = at, by{std::vector<T>(by_pos, by_pos + 3 * v), std::vector<T>(v), std::vector<T>(6 * s.bodies)};
    newton(now, true);
    const T part = share;
    evaluate(now, true, false);
    T& by_scale = to.slots[0].scale;
    for (int64_t i = 0; i < v; ++i) {
      by.impulse[i] = by_tension[i] / scale;
      by_scale -= by_tension[i] * now.impulse[i] / (scale * scale);
      for (int64_t j = 3 * i; j < 3 * i + 3; ++j) {
        const T exerted = touch[j] + between[j];
        by_scale -= (by_whole[j] * (push[j] + exerted) + by_exerted[j] * exerted) / (scale * scale);
        whole[j] = by_whole[j] / scale, contact[j] = (by_whole[j] + by_exerted[j]) / scale;
      }
    }
    for (int64_t b = 0; b < s.bodies; ++b)
      for (int i = 0; i < 6; ++i)
        for (int j = 0; j < 6; ++j) {
          by.bodies[6 * b + j] += inertia[36 * b + 6 * i + j] * by_held[6 * b + i];
          to.inertia[36 * b + 6 * i + j] += by_held[6 * b + i] * now.bodies[6 * b + j];
        }
    pull_back(now, whole, contact, length, torque, by, to);
    evaluate(at, true, true);
    load_pos = by.pos, load_length = by.impulse, load_body = by.bodies;
    solve(true);
    for (int64_t i = 0; i < v; ++i) {
      length[i] = -part * step[3 * v + i];
      for (int c = 0; c < 3; ++c) {
        const int64_t j = 3 * i + c;
        const T here = -part * step[c * v + i];
        to.slots[i].vertex[c] += here * y[j];
        to.slots[i].free -= here * (push[j] + touch[j] + between[j]);
        to.slots[i].moved[c] -= here * slot[i].vertex[c];
        by.pos[j] += here * slot[i].vertex[c];
        whole[j] = contact[j] = -slot[i].free * here;
      }
    }
    for (int64_t b = 0; b < s.bodies; ++b)
      for (int i = 0; i < 6; ++i) {
        const T here = -part * turned[6 * b + i];
        torque[6 * b + i] = -here;
        for (int j = 0; j < 6; ++j) {
          to.inertia[36 * b + 6 * i + j] += scale * here * at.bodies[6 * b + j];
          by_scale += here * inertia[36 * b + 6 * i + j] * at.bodies[6 * b + j];
        }
      }
    pull_back(at, whole, contact, length, torque, by, to);
    for (int64_t i = 0; i < v; ++i) {
      by_scale += by.impulse[i] * tension[i];
      for (int c = 0; c < 3; ++c)
        if (!(slot[i].free > T(0))) to.slots[i].moved[c] += by.pos[3 * i + c];
    }
    firm_back(hard, to);
  }

  // Results: positions, tensions, bodies, hardness; then those of an exact step from there: positions, tensions,
  // forces, forces of contact, wrenches, what is left; and forces of joints before and after, and bodies after.
  void operator()(T* pos, T* tension, T* bodies, T* hard, T* pos2, T* tension2, T* whole, T* exerted, T* held, T* left,
                  T* tied, T* tied2, T* bodies2) {
    prepare();
    State<T> first{std::vector<T>(3 * v), std::vector<T>(v), std::vector<T>(6 * s.bodies), std::vector<T>(gap.size())};
    State<T> found, best, now, last;
    for (size_t i = 0; i < gap.size(); ++i) first.joints[i] = joints.force(0)[i] * scale;
    for (int64_t i = 0; i < v; ++i) {
      for (int c = 0; c < 3; ++c) first.pos[3 * i + c] = slot[i].moved[c];
      first.impulse[i] = guess(i) * scale;
    }
    found = best = first;
    T chosen = T(s.hardness[0]), kept = chosen, smallest = std::numeric_limits<T>::infinity();
    bool open = true;
    for (int64_t t = 0; t < s.tries && open; ++t) {
      chosen = T(s.hardness[t]);
      harden(chosen);
      now = last = first;
      for (int64_t j = 0; j < s.steps[t]; ++j) {
        const State<T> here = now;
        const T rest = newton(now, j >= 2);
        if (j >= 3 && rest < smallest) best = last, kept = chosen, smallest = rest;
        last = here;
        if (rest < T(s.law[5])) {
          open = false;
          break;
        }
      }
      found = now;
    }
    if (open && smallest < std::numeric_limits<T>::infinity()) found = best, chosen = kept;
    for (int64_t i = 0; i < v; ++i) {
      for (int c = 0; c < 3; ++c) pos[c * v + i] = found.pos[3 * i + c];
      tension[i] = found.impulse[i] / scale;
    }
    std::copy(found.bodies.begin(), found.bodies.end(), bodies);
    for (size_t i = 0; i < gap.size(); ++i) tied[i] = found.joints[i] / scale;
    *hard = chosen;
    harden(chosen);
    for (int64_t i = 0; i < v; ++i)
      for (int c = 0; c < 3; ++c)
        if (!(slot[i].free > T(0))) found.pos[3 * i + c] = slot[i].moved[c];
    newton(found, true);
    *left = evaluate(found, true, false);
    for (int64_t i = 0; i < v; ++i) {
      for (int c = 0; c < 3; ++c) {
        const T contact = touch[3 * i + c] + between[3 * i + c];
        pos2[c * v + i] = found.pos[3 * i + c];
        whole[c * v + i] = (push[3 * i + c] + joined[3 * i + c] + contact) / scale;
        exerted[c * v + i] = contact / scale;
      }
      tension2[i] = found.impulse[i] / scale;
    }
    std::copy(found.bodies.begin(), found.bodies.end(), bodies2);
    for (size_t i = 0; i < gap.size(); ++i) tied2[i] = found.joints[i] / scale;
    for (int64_t b = 0; b < s.bodies; ++b)
      for (int i = 0; i < 6; ++i) {
        T sum = 0;
        for (int j = 0; j < 6; ++j) sum += inertia[36 * b + 6 * i + j] * found.bodies[6 * b + j];
        held[6 * b + i] = sum;
      }
  }

 private:
  T guess(int64_t i) const {
    const T pressed = -T(s.law[2]) * slot[i].rest / slot[i].give;
    return slot[i].tension < pressed ? T(0) : slot[i].tension * slot[i].active;
  }

  void prepare() {
    scale = slot[0].scale;
    std::fill(known.begin(), known.end(), -1);
    maps.clear();
    std::vector<T> mass(v), pulled(v);
    const auto centre = [&](int64_t i) { return slot[i].mask / slot[i].rest + slot[before[i]].mask / slot[before[i]].rest; };
    for (int64_t i = 0; i < v; ++i) {
      const int64_t n = s.after[i], p = before[i];
      const T after = slot[i].mask / slot[i].rest, next = slot[n].mask / slot[n].rest, last = slot[p].mask / slot[p].rest;
      one[i] = -slot[i].hinge * centre(i) * after - slot[n].hinge * after * centre(n) - slot[i].swing;
      two[i] = slot[n].hinge * after * next;
      same[i] = slot[i].hinge * centre(i) * centre(i) + slot[n].hinge * after * after + slot[p].hinge * last * last +
                slot[i].swing + slot[p].swing;
      lean[i] = T(s.law[0]) * slot[i].active / slot[i].rest;
      pulled[i] = std::max(guess(i) * scale, T(0)) * lean[i];
    }
    for (int64_t i = 0; i < v; ++i)
      mass[i] = std::min({slot[i].vertex[0], slot[i].vertex[1], slot[i].vertex[2]}) + same[i] + pulled[i] + pulled[before[i]];
    for (int64_t i = 0; i < v; ++i) {
      const int64_t n = s.after[i];
      const bool here = slot[i].free > T(0), there = slot[n].free > T(0);
      least[i] = here && there ? std::min(mass[i], mass[n]) : here ? mass[i] : there ? mass[n] : mass[i];
    }
  }
  void harden(T hard) {
    for (int64_t i = 0; i < v; ++i) firm[i] = hard * least[i];
  }

  // Whether it pushes; the force, and how it falls with the motion.
  bool law(const T* normal, T radius, T wanted, T mu, T stiff, const T* moved, bool exact, Felt<T>& out) const {
    const T along = normal[0] * moved[0] + normal[1] * moved[1] + normal[2] * moved[2];
    const T width = T(s.law[6]) * radius, miss = (wanted - along) / width;
    if (!(miss > -T(s.law[7]))) return false;
    const T small = std::exp(-std::abs(miss));
    const T shut = width * (std::max(miss, T(0)) + std::log1p(small));
    const T slope = (miss > T(0) ? T(1) : small) / (1 + small);
    const T leave = T(s.law[4]) * std::sqrt(T(s.law[8]) * radius);
    const T gone = std::tanh((along - std::max(wanted, T(0))) / leave), fade = 1 - gone;
    const T force = stiff * shut * fade;
    const T steep = out.steep = stiff * (slope * fade + shut * (1 - gone * gone) / leave);
    T slip[3], squared = 0;
    for (int c = 0; c < 3; ++c) slip[c] = moved[c] - normal[c] * along, squared += slip[c] * slip[c];
    const T limit = mu * force, little = limit / stiff, tiny = T(1e-9) * radius;
    const T size = std::sqrt(squared + little * little + tiny * tiny), drag = limit / size, stuck = little / size;
    for (int a = 0; a < 3; ++a) {
      out.force[a] = force * normal[a] - drag * slip[a];
      for (int b = 0; b < 3; ++b) {
        T g = steep * normal[a] * normal[b] + drag * (T(a == b) - normal[a] * normal[b]);
        if (exact) {
          g -= drag * slip[a] * slip[b] / (size * size);
          g -= mu * steep * (1 - stuck * stuck) * slip[a] / size * normal[b];
        }
        out.gradient[3 * a + b] = g;
      }
    }
    return true;
  }

  // Adds the derivative of u . force, by the motion and by what the law is made of; returns the force.
  struct Moved {
    T force[3], moved[3], normal[3], radius, wanted, mu, stiff;
  };
  bool law_back(const T* n, T radius, T wanted, T mu, T stiff, const T* moved, const T* u, Moved& to) const {
    Felt<T> felt;
    if (!law(n, radius, wanted, mu, stiff, moved, true, felt)) return false;
    const T along = n[0] * moved[0] + n[1] * moved[1] + n[2] * moved[2], width = T(s.law[6]) * radius;
    const T miss = (wanted - along) / width, small = std::exp(-std::abs(miss));
    const T soft = std::max(miss, T(0)) + std::log1p(small), shut = width * soft;
    const T slope = (miss > T(0) ? T(1) : small) / (1 + small);
    const T leave = T(s.law[4]) * std::sqrt(T(s.law[8]) * radius), beyond = along - std::max(wanted, T(0));
    const T gone = std::tanh(beyond / leave), fade = 1 - gone, fall = (1 - gone * gone) / leave;
    const T force = stiff * shut * fade;
    T slip[3], squared = 0, nu = 0, slip_u = 0;
    for (int c = 0; c < 3; ++c) {
      slip[c] = moved[c] - n[c] * along;
      squared += slip[c] * slip[c], nu += n[c] * u[c], slip_u += slip[c] * u[c];
    }
    const T limit = mu * force, little = limit / stiff, tiny = T(1e-9) * radius;
    const T size = std::sqrt(squared + little * little + tiny * tiny), drag = limit / size, stuck = little / size;
    const T by_force = nu - slip_u * mu / size * (1 - stuck * stuck);
    to.mu = -slip_u * force / size * (1 - stuck * stuck);
    to.stiff = by_force * force / stiff - slip_u * drag * stuck * stuck / stiff;
    to.wanted = by_force * stiff * (slope * fade + (wanted >= T(0) ? shut * fall : T(0)));
    to.radius = by_force * stiff * (T(s.law[6]) * (soft - slope * miss) * fade + shut * fall * beyond / (2 * radius));
    to.radius += slip_u * drag * tiny / (size * size) * T(1e-9);
    T by_along = -by_force * stiff * (slope * fade + shut * fall), by_slip[3];
    for (int c = 0; c < 3; ++c) {
      by_slip[c] = -drag * u[c] + slip_u * drag * slip[c] / (size * size);
      by_along -= n[c] * by_slip[c];
    }
    for (int c = 0; c < 3; ++c) {
      to.force[c] = felt.force[c];
      to.moved[c] = by_slip[c] + n[c] * by_along;
      to.normal[c] = force * u[c] - along * by_slip[c] + moved[c] * by_along;
    }
    return true;
  }

  static T inner(const T* a, const T* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
  static void cross(const T* a, const T* b, T* to) {
    for (int c = 0; c < 3; ++c) to[c] = a[(c + 1) % 3] * b[(c + 2) % 3] - a[(c + 2) % 3] * b[(c + 1) % 3];
  }
  // Adds the derivative of g . `Maps` (x, y, z) by the point.
  static void maps_back(const Point<T>& p, const T* g, const T* x, const T* y, const T* z, Point<T>& to) {
    const T *n = p.normal, *t = p.tangent, d[3] = {y[0] - x[0], y[1] - x[1], y[2] - x[2]};
    const T nd = inner(n, d), gt = inner(g, t), nt = inner(n, t), gd = inner(g, d);
    to.share += gd;
    to.lever += gt * nd - nt * gd;
    for (int c = 0; c < 3; ++c) {
      to.tangent[c] += p.lever * (nd * g[c] - gd * n[c]);
      to.normal[c] += p.lever * (gt * d[c] - gd * t[c]);
    }
    if (!z) return;
    const T *r = z + 3, tr = inner(t, r);
    T some[3];
    cross(r, g, some);
    for (int c = 0; c < 3; ++c) to.arm[c] += some[c];
    if (!(p.lever > T(0))) return;
    const T across[3] = {r[0] - t[0] * tr, r[1] - t[1] * tr, r[2] - t[2] * tr};
    cross(across, g, some);
    to.radius -= inner(n, some);
    for (int c = 0; c < 3; ++c) to.normal[c] -= p.radius * some[c];
    cross(n, g, some);
    const T st = inner(some, t) * p.radius;
    for (int c = 0; c < 3; ++c) to.tangent[c] -= st * r[c] + tr * p.radius * some[c];
  }

  // Adds the derivative by a state and by what the scene is made of, from those by what pushes vertices without contact
  // and in contact, by excess of lengths, and by wrenches on bodies; after `evaluate` at that state.
  void pull_back(const State<T>& now, const std::vector<T>& whole, const std::vector<T>& contact,
                 const std::vector<T>& length, const std::vector<T>& torque, State<T>& by, Parts to) {
    std::vector<T> moment(3 * v), arch(3 * v), shift(3 * v, T(0));
    T& by_scale = to.slots[0].scale;
    for (int64_t i = 0; i < v; ++i) {
      const Slot<T>& p = slot[i];
      Slot<T>& d = to.slots[i];
      const int64_t n = s.after[i];
      const T tension = now.impulse[i] / scale, far = length[i] * p.active;
      const bool yields = tension > yielding(i);
      d.rest -= far * (yields ? 1 - T(s.law[1]) : T(1));
      d.compliance -= far * tension;
      const T by_tension = -far * (p.compliance + (yields ? p.give : T(0)));
      by.impulse[i] += by_tension / scale;
      by_scale -= by_tension * tension / scale;
      for (int c = 0; c < 3; ++c) {
        const int64_t j = 3 * i + c, m = 3 * n + c;
        const T pulled = whole[j] - whole[m], turned = y[m] - y[j];
        by.impulse[i] += pulled * begin[j];
        const T leant = now.impulse[i] * pulled;
        d.start[c] += leant, d.lead[c] += p.active * leant;
        by_lean[i] += leant * turned;
        d.swing += pulled * turned;
        d.rest -= pulled * resist[j] / p.rest;
        moment[j] = pulled * p.mask / p.rest;
        const T moves = lean[i] * leant + p.swing * pulled;
        shift[m] += moves, shift[j] -= moves;
        d.force[c] += scale * whole[j];
        by_scale += p.force[c] * whole[j];
        by.pos[m] += far * along[j], by.pos[j] -= far * along[j];
      }
    }
    for (int64_t i = 0; i < v; ++i)
      for (int c = 0; c < 3; ++c) {
        const int64_t j = 3 * i + c, b = 3 * before[i] + c;
        arch[j] = moment[j] - moment[b];
        to.slots[i].hinge += arch[j] * (turn[j] - turn[b]);
      }
    for (int64_t i = 0; i < v; ++i)
      for (int c = 0; c < 3; ++c) {
        const int64_t n = s.after[i], j = 3 * i + c, m = 3 * n + c;
        const T by_turn = slot[i].hinge * arch[j] - slot[n].hinge * arch[m], moves = by_turn * slot[i].mask / slot[i].rest;
        to.slots[i].rest -= by_turn * turn[j] / slot[i].rest;
        shift[m] += moves, shift[j] -= moves;
      }
    for (int64_t i = 0; i < v; ++i)
      for (int c = 0; c < 3; ++c) by.pos[3 * i + c] += shift[3 * i + c], to.slots[i].moved[c] -= shift[3 * i + c];
    points_back(now, contact, torque, by, to);
    pairs_back(now, contact, by, to);
  }

  void points_back(const State<T>& now, const std::vector<T>& contact, const std::vector<T>& torque, State<T>& by,
                   Parts to) {
    for (int64_t f = 0; f < s.families; ++f) {
      const int64_t body = s.of[f];
      for (int64_t i = 0; i < v; ++i) {
        const Point<T>& p = points[f * v + i];
        if (!(p.real > T(0))) continue;
        const int64_t n = s.after[i];
        T one[3], two[3];
        displaced(now, i, one), displaced(now, n, two);
        const T* q = body >= 0 ? &now.bodies[6 * body] : nullptr;
        if (!(p.wanted - parted(p, one, two, q) > -T(s.law[7] * s.law[6]) * p.radius)) continue;
        const Maps<T>& m = mapped(f * v + i);
        T moved[3] = {p.given[0], p.given[1], p.given[2]}, u[3] = {};
        times(m.first, one, moved, 3), times(m.first, &contact[3 * i], u, 3);
        times(m.second, two, moved, 3), times(m.second, &contact[3 * n], u, 3);
        if (q) times(m.body, q, moved, 6), times(m.body, &torque[6 * body], u, 6);
        Moved d;
        if (!law_back(p.normal, p.radius, p.wanted, p.mu, firm[i], moved, u, d)) continue;
        Point<T>& mine = to.points[f * v + i];
        for (int c = 0; c < 3; ++c) mine.normal[c] += d.normal[c], mine.given[c] += d.moved[c];
        mine.radius += d.radius, mine.wanted += d.wanted, mine.mu += d.mu;
        by_firm[i] += d.stiff;
        maps_back(p, d.moved, one, two, q, mine);
        maps_back(p, d.force, &contact[3 * i], &contact[3 * n], q ? &torque[6 * body] : nullptr, mine);
        T first[3] = {}, second[3] = {};
        back(m.first, d.moved, first, 3), back(m.second, d.moved, second, 3);
        arrived(i, first, by, to), arrived(n, second, by, to);
        if (q) back(m.body, d.moved, &by.bodies[6 * body], 6);
      }
    }
  }
  void pairs_back(const State<T>& now, const std::vector<T>& contact, State<T>& by, Parts to) {
    for (int64_t k = 0; k < s.pairs; ++k) {
      const Pair<T>& p = pairs[k];
      if (!(p.real > T(0))) continue;
      const int64_t* at = corners + 4 * k;
      T moved[3] = {}, u[3] = {}, change[4][3];
      for (int q = 0; q < 4; ++q) {
        displaced(now, at[q], change[q]);
        times(p.corner[q], change[q], moved, 3), times(p.corner[q], &contact[3 * at[q]], u, 3);
      }
      const T one = firm[at[0]], other = firm[at[2]];
      Moved d;
      if (!law_back(p.normal, p.radius, p.wanted, p.mu, std::min(one, other), moved, u, d)) continue;
      Pair<T>& mine = to.pairs[k];
      for (int c = 0; c < 3; ++c) mine.normal[c] += d.normal[c];
      mine.radius += d.radius, mine.wanted += d.wanted, mine.mu += d.mu;
      shared(one, other, d.stiff, by_firm[at[0]], by_firm[at[2]]);
      for (int q = 0; q < 4; ++q) {
        T end[3] = {};
        back(p.corner[q], d.moved, end, 3);
        arrived(at[q], end, by, to);
        for (int a = 0; a < 3; ++a)
          for (int c = 0; c < 3; ++c)
            mine.corner[q][3 * a + c] += d.moved[a] * change[q][c] + d.force[a] * contact[3 * at[q] + c];
      }
    }
  }
  void displaced(const State<T>& now, int64_t i, T* to) const {
    for (int c = 0; c < 3; ++c) to[c] = now.pos[3 * i + c] - slot[i].origin[c];
  }
  static void arrived(int64_t i, const T* by_change, State<T>& by, Parts to) {
    for (int c = 0; c < 3; ++c) by.pos[3 * i + c] += by_change[c], to.slots[i].origin[c] -= by_change[c];
  }
  // Adds the derivative of the smaller one of two numbers: half to each where they are the same.
  static void shared(T one, T other, T by, T& to_one, T& to_other) {
    if (one < other)
      to_one += by;
    else if (other < one)
      to_other += by;
    else
      to_one += by / 2, to_other += by / 2;
  }

  // Adds the derivative by what `prepare` made the stiffness of.
  void firm_back(T hard, Parts to) {
    std::vector<T> by_mass(v, T(0)), by_after(v, T(0)), by_centre(v), size(v);
    const auto after = [&](int64_t i) { return slot[i].mask / slot[i].rest; };
    for (int64_t i = 0; i < v; ++i)
      size[i] = std::min({slot[i].vertex[0], slot[i].vertex[1], slot[i].vertex[2]}) + same[i] + pulled(i) + pulled(before[i]);
    for (int64_t i = 0; i < v; ++i) {
      const int64_t n = s.after[i];
      const bool here = slot[i].free > T(0), there = slot[n].free > T(0);
      const T by = hard * by_firm[i];
      if (here && there)
        shared(size[i], size[n], by, by_mass[i], by_mass[n]);
      else
        by_mass[there ? n : i] += by;
    }
    for (int64_t i = 0; i < v; ++i) {
      const Slot<T>& p = slot[i];
      Slot<T>& d = to.slots[i];
      const int64_t n = s.after[i], b = before[i];
      const T by = by_mass[i], least = std::min({p.vertex[0], p.vertex[1], p.vertex[2]});
      int many = 0;
      for (int c = 0; c < 3; ++c) many += p.vertex[c] == least;
      for (int c = 0; c < 3; ++c) d.vertex[c] += p.vertex[c] == least ? by / many : T(0);
      const T centre = after(i) + after(b);
      d.hinge += by * centre * centre;
      to.slots[n].hinge += by * after(i) * after(i);
      to.slots[b].hinge += by * after(b) * after(b);
      by_centre[i] = 2 * by * p.hinge * centre;
      by_after[i] += 2 * by * slot[n].hinge * after(i);
      by_after[b] += 2 * by * slot[b].hinge * after(b);
      d.swing += by, to.slots[b].swing += by;
      const T pull = guess(i) * scale, by_pulled = by_mass[i] + by_mass[n];
      if (!(pull >= T(0))) continue;
      by_lean[i] += by_pulled * pull;
      to.slots[0].scale += by_pulled * lean[i] * guess(i);
      if (!(p.tension < -T(s.law[2]) * p.rest / p.give)) d.tension += by_pulled * lean[i] * scale * p.active;
    }
    for (int64_t i = 0; i < v; ++i) {
      const T by = by_after[i] + by_centre[i] + by_centre[s.after[i]];
      to.slots[i].rest -= (by * after(i) + by_lean[i] * lean[i]) / slot[i].rest;
    }
  }
  T pulled(int64_t i) const { return std::max(guess(i) * scale, T(0)) * lean[i]; }

  T& at(int64_t row, int64_t column) {
    const int64_t r = rank[row], c = rank[column];
    return band[r * (2 * k + 1) + c - r + k];
  }
  // (x^T g z) of 3 x 3 matrices, times a factor, at the components of two vertices.
  void block(int64_t i, int64_t j, const T* left, const T* right, const T* g, T factor) {
    if (factor == T(0)) return;
    T half[9] = {};
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b)
        for (int c = 0; c < 3; ++c) half[3 * a + b] += g[3 * a + c] * right[3 * c + b];
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 3; ++b) {
        T sum = 0;
        for (int c = 0; c < 3; ++c) sum += left[3 * c + a] * half[3 * c + b];
        at(a * v + i, b * v + j) += factor * sum;
      }
  }

  struct Acting {
    int64_t pair;
    Felt<T> felt;
    int64_t row;  // the first of its rows in the matrix
  };
  int64_t first_row(const int64_t* at) const {
    int64_t first = n;
    for (int q = 0; q < 4; ++q)
      for (int c = 0; c < 3; ++c) first = std::min(first, rank[c * v + at[q]]);
    return first;
  }

  // Forces at a state and what is left of the equations; with the matrix, if that is asked for.
  T evaluate(const State<T>& now, bool exact, bool matrix) {
    for (int64_t i = 0; i < 3 * v; ++i) touch[i] = between[i] = 0;
    std::fill(wrench.begin(), wrench.end(), T(0));
    for (int64_t i = 0; i < v; ++i)
      for (int c = 0; c < 3; ++c) y[3 * i + c] = now.pos[3 * i + c] - slot[i].moved[c];
    for (int64_t i = 0; i < v; ++i) {
      const Slot<T>& p = slot[i];
      const int64_t n = s.after[i];
      T size = 0, e[3];
      for (int c = 0; c < 3; ++c) {
        const T turned = y[3 * n + c] - y[3 * i + c];
        begin[3 * i + c] = p.start[c] + p.active * p.lead[c] + lean[i] * turned;
        pull[3 * i + c] = now.impulse[i] * begin[3 * i + c] + p.swing * turned;
        turn[3 * i + c] = turned * p.mask / p.rest;
        e[c] = p.mask > T(0) ? now.pos[3 * n + c] - now.pos[3 * i + c] : T(c == 0);
        size += e[c] * e[c];
      }
      size = std::sqrt(size);
      for (int c = 0; c < 3; ++c) along[3 * i + c] = e[c] / std::max(size, T(1e-12));
      const T tension = now.impulse[i] / scale, beyond = tension - yielding(i);
      excess[i] = (size - p.rest - p.compliance * tension - p.give * std::max(beyond, T(0))) * p.active;
    }
    const auto moment = [&](int64_t i, int c) { return (turn[3 * i + c] - turn[3 * before[i] + c]) * slot[i].hinge; };
    for (int64_t i = 0; i < v; ++i)
      for (int c = 0; c < 3; ++c)
        resist[3 * i + c] = (moment(i, c) - moment(s.after[i], c)) * slot[i].mask / slot[i].rest;
    for (int64_t i = 0; i < v; ++i)
      for (int c = 0; c < 3; ++c) {
        const int64_t p = 3 * before[i] + c;
        push[3 * i + c] = slot[i].force[c] * scale + pull[3 * i + c] - pull[p] - resist[p] + resist[3 * i + c];
      }
    if (matrix) assemble(now);
    touch_bodies(now, exact, matrix);
    touch_ropes(now, exact, matrix);
    T worst = 0, size = 0, strain = pull_joints(now, matrix);
    for (int64_t i = 0; i < v; ++i) {
      const Slot<T>& p = slot[i];
      strain = std::max(strain, std::abs(excess[i]) / p.rest);
      for (int c = 0; c < 3; ++c) {
        const int64_t j = 3 * i + c;
        residual[j] = p.vertex[c] * y[j] - p.free * (push[j] + touch[j] + between[j] + joined[j]);
        const T carried = T(1e-3) * (p.moved[c] - p.origin[c]) + T(1e-9) * p.rest;
        const T whole = std::abs(p.vertex[c] * y[j]) + std::abs(scale * p.force[c]) + std::abs(touch[j]) +
                        std::abs(now.impulse[i] * begin[j]) + std::abs(between[j]) + std::abs(joined[j]) +
                        std::abs(p.vertex[c] * carried);
        worst = std::max(worst, std::abs(residual[j]));
        size = std::max(size, whole);
      }
    }
    return std::max(worst / std::max(size, T(1e-30)), strain);
  }
  T yielding(int64_t i) const { return T(s.law[1]) * slot[i].rest / slot[i].give; }

  void assemble(const State<T>& now) {
    band.assign((n + k) * (2 * k + 1), T(0));
    border.assign(n * own, T(0));
    row.assign(n * own, T(0));
    corner.assign(36 * s.bodies, T(0));
    for (int64_t i = 0; i < v; ++i) {
      const Slot<T>& p = slot[i];
      const int64_t next = s.after[i], b = before[i], far = s.after[next];
      const bool inside = p.mask > T(0), further = inside && slot[next].mask > T(0);
      const T string = now.impulse[i] * lean[i], own = same[i] + string + now.impulse[b] * lean[b];
      const int64_t* to = &places[28 * i];
      for (int c = 0; c < 3; ++c, to += 9) {
        band[to[0]] += p.vertex[c] + p.free * own;
        if (inside) {
          band[to[1]] += p.free * (one[i] - string);
          band[to[2]] += slot[next].free * (one[i] - string);
          band[to[3]] -= p.free * p.active * begin[3 * i + c];
          band[to[4]] += slot[next].free * p.active * begin[3 * i + c];
          band[to[5]] -= p.active * along[3 * i + c];
          band[to[6]] += p.active * along[3 * i + c];
        }
        if (further) {
          band[to[7]] += p.free * two[i];
          band[to[8]] += slot[far].free * two[i];
        }
      }
      const T soft = (now.impulse[i] / scale > yielding(i) ? p.give : T(0)) + T(s.law[3]) * p.give;
      band[*to] += -p.active * (p.compliance + soft) / scale + (p.active - 1);
    }
  }

  // By how much a point parts from its body; as from `Maps`, whose parts along the normal are these.
  T parted(const Point<T>& p, const T* one, const T* two, const T* q) const {
    const T *n = p.normal, *r = p.arm;
    T sum = 0;
    for (int c = 0; c < 3; ++c) sum += n[c] * (p.given[c] + (1 - p.share) * one[c] + p.share * two[c]);
    if (!q) return sum;
    for (int c = 0; c < 3; ++c) {
      const int d = (c + 1) % 3, e = (c + 2) % 3;
      sum += n[c] * (r[d] * q[3 + e] - r[e] * q[3 + d] - q[c]);
    }
    return sum;
  }
  const Maps<T>& mapped(int64_t point) {
    if (known[point] < 0) known[point] = int64_t(maps.size()), maps.emplace_back(points[point]);
    return maps[known[point]];
  }

  void touch_bodies(const State<T>& now, bool exact, bool matrix) {
    for (int64_t f = 0; f < s.families; ++f) {
      const int64_t body = s.of[f];
      for (int64_t i = 0; i < v; ++i) {
        const Point<T>& p = points[f * v + i];
        if (!(p.real > T(0))) continue;
        const int64_t n = s.after[i];
        T one[3], two[3];
        for (int c = 0; c < 3; ++c) {
          one[c] = now.pos[3 * i + c] - slot[i].origin[c];
          two[c] = now.pos[3 * n + c] - slot[n].origin[c];
        }
        const T* q = body >= 0 ? &now.bodies[6 * body] : nullptr;
        if (!(p.wanted - parted(p, one, two, q) > -T(s.law[7] * s.law[6]) * p.radius)) continue;
        const Maps<T>& m = mapped(f * v + i);
        T moved[3] = {p.given[0], p.given[1], p.given[2]};
        times(m.first, one, moved, 3);
        times(m.second, two, moved, 3);
        if (q) times(m.body, q, moved, 6);
        Felt<T> felt;
        if (!law(p.normal, p.radius, p.wanted, p.mu, firm[i], moved, exact, felt)) continue;
        back(m.first, felt.force, &touch[3 * i], 3);
        back(m.second, felt.force, &touch[3 * n], 3);
        if (q) back(m.body, felt.force, &wrench[6 * body], 6);
        if (!matrix) continue;
        block(i, i, m.first, m.first, felt.gradient, slot[i].free);
        block(i, n, m.first, m.second, felt.gradient, slot[i].free);
        block(n, i, m.second, m.first, felt.gradient, slot[n].free);
        block(n, n, m.second, m.second, felt.gradient, slot[n].free);
        if (q) edge_of_body(m, felt.gradient, i, n, body);
      }
    }
  }

  void edge_of_body(const Maps<T>& p, const T* g, int64_t i, int64_t n, int64_t body) {
    T kc[18] = {}, ka[9] = {}, kb[9] = {};
    for (int a = 0; a < 3; ++a) {
      for (int j = 0; j < 6; ++j)
        for (int c = 0; c < 3; ++c) kc[6 * a + j] += g[3 * a + c] * p.body[6 * c + j];
      for (int j = 0; j < 3; ++j)
        for (int c = 0; c < 3; ++c) {
          ka[3 * a + j] += g[3 * a + c] * p.first[3 * c + j];
          kb[3 * a + j] += g[3 * a + c] * p.second[3 * c + j];
        }
    }
    const int64_t wide = own, first = 6 * body;
    for (int a = 0; a < 3; ++a)
      for (int j = 0; j < 6; ++j) {
        T one = 0, two = 0, three = 0, four = 0;
        for (int c = 0; c < 3; ++c) {
          one += p.first[3 * c + a] * kc[6 * c + j];
          two += p.second[3 * c + a] * kc[6 * c + j];
          three += p.body[6 * c + j] * ka[3 * c + a];
          four += p.body[6 * c + j] * kb[3 * c + a];
        }
        border[(a * v + i) * wide + first + j] += slot[i].free * one;
        border[(a * v + n) * wide + first + j] += slot[n].free * two;
        row[(a * v + i) * wide + first + j] += three;
        row[(a * v + n) * wide + first + j] += four;
      }
    for (int a = 0; a < 6; ++a)
      for (int j = 0; j < 6; ++j)
        for (int c = 0; c < 3; ++c) corner[36 * body + 6 * a + j] += p.body[6 * c + a] * kc[6 * c + j];
  }

  void touch_ropes(const State<T>& now, bool exact, bool matrix) {
    acting.clear();
    for (int64_t q = 0; q < s.pairs; ++q) {
      const Pair<T>& p = pairs[q];
      if (!(p.real > T(0))) continue;
      const int64_t* at = corners + 4 * q;
      T moved[3] = {};
      for (int m = 0; m < 4; ++m) {
        T d[3];
        for (int c = 0; c < 3; ++c) d[c] = now.pos[3 * at[m] + c] - slot[at[m]].origin[c];
        times(p.corner[m], d, moved, 3);
      }
      Felt<T> felt;
      const T stiff = std::min(firm[at[0]], firm[at[2]]);
      if (!law(p.normal, p.radius, p.wanted, p.mu, stiff, moved, exact, felt)) continue;
      for (int m = 0; m < 4; ++m) back(p.corner[m], felt.force, &between[3 * at[m]], 3);
      // What changes by less than rounding has no part in the matrix.
      if (matrix && felt.steep > std::numeric_limits<T>::epsilon() / 4 * stiff) acting.push_back({q, felt, first_row(at)});
    }
  }

  // What joints do to vertices and bodies; returns by how far they miss, over the shortest edge.
  T pull_joints(const State<T>& now, bool matrix) {
    if (gap.empty()) return T(0);
    const Tied& tied = s.tied;
    std::fill(joined.begin(), joined.end(), T(0));
    if (matrix) levers.assign(18 * tied.count, T(0)), reach.assign(18 * tied.count, T(0));
    T worst = 0, edge = std::numeric_limits<T>::infinity();
    for (int64_t i = 0; i < v; ++i)
      if (slot[i].mask > T(0)) edge = std::min(edge, slot[i].rest);
    for (int64_t a = 0; a < tied.count; ++a) {
      joints.gap(a, now.pos.data(), now.bodies.data(), T(s.law[4]), &gap[3 * a], matrix ? &reach[18 * a] : nullptr);
      const T *force = &now.joints[3 * a], *r = joints.arm(a);
      for (int c = 0; c < 3; ++c) worst = std::max(worst, std::abs(gap[3 * a + c]));
      for (int64_t q = tied.first[a]; q < tied.first[a + 1]; ++q)
        for (int c = 0; c < 3; ++c) {
          const int64_t i = tied.slot[q], at = (c * v + i) * own + 6 * s.bodies + 3 * a + c;
          const T weight = T(tied.weight[q]);
          joined[3 * i + c] += weight * force[c];
          if (matrix) border[at] -= slot[i].free * weight, row[at] += weight;
        }
      const int64_t b = tied.body[a];
      if (b < 0) continue;
      for (int c = 0; c < 3; ++c) {
        const int d = (c + 1) % 3, e = (c + 2) % 3;
        wrench[6 * b + c] -= force[c];
        wrench[6 * b + 3 + c] -= r[d] * force[e] - r[e] * force[d];
        if (!matrix) continue;
        T* lever = &levers[18 * a];  // (6, 3)
        lever[3 * c + c] = 1;
        lever[3 * (3 + c) + e] = r[d], lever[3 * (3 + c) + d] = -r[e];
      }
    }
    return worst / edge;
  }

  // Takes a step; returns what was left before it.
  T newton(State<T>& now, bool exact) {
    const T left = evaluate(now, exact, true);
    for (int64_t i = 0; i < 3 * v; ++i) load_pos[i] = -residual[i];
    for (int64_t i = 0; i < v; ++i) load_length[i] = -excess[i];
    for (int64_t b = 0; b < s.bodies; ++b)
      for (int i = 0; i < 6; ++i) {
        T sum = wrench[6 * b + i];
        for (int j = 0; j < 6; ++j) sum -= scale * inertia[36 * b + 6 * i + j] * now.bodies[6 * b + j];
        load_body[6 * b + i] = sum;
      }
    for (size_t i = 0; i < gap.size(); ++i) load_body[6 * s.bodies + i] = -gap[i];
    solve(false);
    T most = 0;
    for (int64_t i = 0; i < v; ++i) {
      T squared = 0;
      for (int c = 0; c < 3; ++c) {
        const T turned = slot[i].active * (step[c * v + s.after[i]] - step[c * v + i]) / slot[i].rest;
        squared += turned * turned;
      }
      most = std::max(most, squared);
    }
    most = std::sqrt(most);
    share = most > T(1) ? 1 / most : T(1);
    for (int64_t i = 0; i < v; ++i) {
      for (int c = 0; c < 3; ++c) now.pos[3 * i + c] += share * step[c * v + i];
      now.impulse[i] += share * step[3 * v + i];
    }
    for (int64_t b = 0; b < 6 * s.bodies; ++b) now.bodies[b] += share * turned[b];
    for (size_t i = 0; i < gap.size(); ++i) now.joints[i] += share * turned[6 * s.bodies + i];
    return left;
  }

  // How the equations of vertices feel the force of an acting pair, and how that feels vertices.
  T given(const Acting& a, int q, int c, int f) const {
    return slot[corners[4 * a.pair + q]].free * pairs[a.pair].corner[q][3 * f + c];
  }
  T feeling(const Acting& a, int q, int c, int f) const {
    T sum = 0;
    for (int g = 0; g < 3; ++g) sum += a.felt.gradient[3 * f + g] * pairs[a.pair].corner[q][3 * g + c];
    return sum;
  }
  void transpose() {
    const int64_t width = 2 * k + 1;
    other.assign(band.size(), T(0));
    for (int64_t r = 0; r < n; ++r)
      for (int64_t c = std::max<int64_t>(0, r - k); c <= std::min(n - 1, r + k); ++c)
        other[c * width + r - c + k] = band[r * width + c - r + k];
    band.swap(other), border.swap(row);
    for (int64_t b = 0; b < s.bodies; ++b)
      for (int i = 0; i < 6; ++i)
        for (int j = 0; j < i; ++j) std::swap(corner[36 * b + 6 * i + j], corner[36 * b + 6 * j + i]);
  }

  // Solves for `step` and `turned` what `load_pos`, `load_length` and `load_body` are to be; or the transposed system.
  void solve(bool transposed) {
    const int64_t extra = own + 3 * (int64_t)acting.size(), m = 1 + extra;
    if (transposed) transpose();
    std::sort(acting.begin(), acting.end(), [](const Acting& a, const Acting& b) { return a.row < b.row; });
    side.assign((n + k) * m, T(0));  // by rank
    for (int64_t i = 0; i < v; ++i) {
      for (int c = 0; c < 3; ++c) side[rank[c * v + i] * m] = load_pos[3 * i + c];
      side[rank[3 * v + i] * m] = load_length[i];
    }
    for (int64_t u = 0; u < 3 * v; ++u)
      for (int64_t j = 0; j < own; ++j) side[rank[u] * m + 1 + j] = border[u * own + j];
    for (size_t a = 0; a < acting.size(); ++a) {
      const int64_t* at = corners + 4 * acting[a].pair;
      for (int q = 0; q < 4; ++q)
        for (int c = 0; c < 3; ++c)
          for (int f = 0; f < 3; ++f)
            side[rank[c * v + at[q]] * m + 1 + own + 3 * a + f] +=
                transposed ? feeling(acting[a], q, c, f) : given(acting[a], q, c, f);
    }
    switch (k) {
      case 8: eliminate<8>(m); break;
      case 16: eliminate<16>(m); break;
      default: eliminate<0>(m);
    }
    turned.assign(own, T(0));
    if (extra) border_out(transposed, extra, m);
    for (int64_t u = 0; u < n; ++u) step[u] = side[rank[u] * m];
  }

  // Solves the banded system for all columns of `side`; K is half its bandwidth, or 0 for any.
  template <int K>
  void eliminate(int64_t m) {
    const int64_t k = K ? K : this->k, width = 2 * k + 1;
    int64_t used = 1 + own;  // columns that are not 0 yet: pairs stand in the order of their first rows
    size_t next = 0;
    for (int64_t i = 0; i < n; ++i) {
      while (next < acting.size() && acting[next].row <= i) ++next, used += 3;
      T* pivot = &band[i * width + k];
      const T inverse = *pivot = 1 / *pivot;
      const T* mine = &side[i * m];
      for (int64_t l = 1; l <= k; ++l) {
        T* below = &band[(i + l) * width + k - l];
        const T factor = *below * inverse;
        if (factor == T(0)) continue;
        for (int64_t u = 1; u <= k; ++u) below[u] -= factor * pivot[u];
        T* theirs = &side[(i + l) * m];
        for (int64_t j = 0; j < used; ++j) theirs[j] -= factor * mine[j];
      }
    }
    for (int64_t i = n - 1; i >= 0; --i) {
      const T* pivot = &band[i * width + k];
      T* mine = &side[i * m];
      for (int64_t u = 1; u <= k && i + u < n; ++u) {
        const T factor = pivot[u];
        if (factor == T(0)) continue;
        const T* theirs = &side[(i + u) * m];
        for (int64_t j = 0; j < m; ++j) mine[j] -= factor * theirs[j];
      }
      for (int64_t j = 0; j < m; ++j) mine[j] *= *pivot;
    }
  }

  // Takes bodies, joints and pairs out by their Schur complement.
  void border_out(bool transposed, int64_t extra, int64_t m) {
    std::vector<T> small(extra * (extra + 1), T(0));  // with its right-hand side behind
    const auto entry = [&](int64_t i, int64_t j) -> T& { return small[i * (extra + 1) + j]; };
    const auto minus = [&](int64_t i, T factor, int64_t unknown) {
      const T* x = &side[rank[unknown] * m];
      for (int64_t j = 0; j < extra; ++j) entry(i, j) -= factor * x[1 + j];
      entry(i, extra) -= factor * x[0];
    };
    for (int64_t b = 0; b < s.bodies; ++b)
      for (int i = 0; i < 6; ++i) {
        for (int j = 0; j < 6; ++j) {
          const T held = scale * inertia[36 * b + (transposed ? 6 * j + i : 6 * i + j)];
          entry(6 * b + i, 6 * b + j) = held + corner[36 * b + 6 * i + j];
        }
        entry(6 * b + i, extra) = load_body[6 * b + i];
      }
    for (int64_t a = 0; a < s.tied.count; ++a)
      for (int c = 0; c < 3; ++c) {
        const int64_t i = 6 * s.bodies + 3 * a + c, b = s.tied.body[a];
        entry(i, extra) = load_body[i];
        for (int j = 0; j < 6 && b >= 0; ++j) {
          entry(6 * b + j, i) = levers[18 * a + 3 * j + c];
          entry(i, 6 * b + j) = -reach[18 * a + 6 * c + j];
        }
      }
    for (int64_t u = 0; u < 3 * v; ++u)
      for (int64_t i = 0; i < own; ++i)
        if (row[u * own + i] != T(0)) minus(i, row[u * own + i], u);
    for (size_t a = 0; a < acting.size(); ++a) {
      const int64_t* at = corners + 4 * acting[a].pair;
      for (int f = 0; f < 3; ++f) {
        const int64_t i = own + 3 * a + f;
        entry(i, i) += 1;
        for (int q = 0; q < 4; ++q)
          for (int c = 0; c < 3; ++c)
            minus(i, -(transposed ? given(acting[a], q, c, f) : feeling(acting[a], q, c, f)), c * v + at[q]);
      }
    }
    for (int64_t i = 0; i < extra; ++i) {
      int64_t best = i;
      for (int64_t l = i + 1; l < extra; ++l)
        if (std::abs(entry(l, i)) > std::abs(entry(best, i))) best = l;
      if (best != i)
        for (int64_t j = i; j <= extra; ++j) std::swap(entry(i, j), entry(best, j));
      const T inverse = 1 / entry(i, i);
      for (int64_t l = i + 1; l < extra; ++l) {
        const T factor = entry(l, i) * inverse;
        if (factor == T(0)) continue;
        for (int64_t j = i; j <= extra; ++j) entry(l, j) -= factor * entry(i, j);
      }
    }
    std::vector<T> found(extra);
    for (int64_t i = extra - 1; i >= 0; --i) {
      T sum = entry(i, extra);
      for (int64_t j = i + 1; j < extra; ++j) sum -= entry(i, j) * found[j];
      found[i] = sum / entry(i, i);
    }
    std::copy(found.begin(), found.begin() + own, turned.begin());
    for (int64_t r = 0; r < n; ++r) {
      T* x = &side[r * m];
      for (int64_t j = 0; j < extra; ++j) x[0] -= x[1 + j] * found[j];
    }
  }

  const Sizes& s;
  const int64_t v, n, k, own;  // own: unknowns of bodies and joints
  std::vector<int64_t> before, rank;
  std::vector<int64_t> places;  // where the entries of `assemble` stand in the band, 28 for each slot
  std::vector<T> y, begin, along, push, pull, turn, resist, touch, between, joined, residual, excess, lean, one, two, same, firm,
      least, wrench, step, band, border, row, corner, side, turned, load_pos, load_length, load_body, gap, levers, reach, other, by_firm,
      by_lean;
  std::vector<Acting> acting;
  std::vector<int64_t> known;  // where the maps of points are, -1 for those that nothing asked for
  std::vector<Maps<T>> maps;
  T scale, share;
};

// Reads numbers of structs behind each other, in a family and a scene.
template <typename T, class S>
void gather(S* to, int64_t count, const T* const* in, const Place* places, int64_t family, int64_t scene) {
  constexpr int64_t wide = sizeof(S) / sizeof(T);
  for (int64_t k = 0; k < wide; ++k) {
    const Place& p = places[k];
    const T* from = in[p.input] + p.offset + family * p.family + scene * p.scene;
    T* at = (T*)to + k;
    for (int64_t i = 0; i < count; ++i) at[i * wide] = from[i * p.slot];
  }
}

// A scene as `Scene` reads it.
template <typename T>
struct Given {
  std::vector<Slot<T>> slots;
  std::vector<Point<T>> points;
  std::vector<Pair<T>> pairs;
  std::vector<int64_t> corners;
  std::vector<T> inertia;

  explicit Given(const Sizes& s)
      : slots(s.slots), points(s.families * s.slots), pairs(s.pairs), corners(4 * s.pairs), inertia(36 * s.bodies) {}

  void read(const T* const* in, const int64_t* at, const Inputs& n, const Sizes& s, int64_t b, Scene<T>& scene) {
    const int64_t v = s.slots;
    gather(slots.data(), v, in, n.slots, 0, b);
    for (int64_t f = 0; f < s.families; ++f) gather(&points[f * v], v, in, n.points, f, b);
    const Place& real = n.pairs[0];
    for (int64_t q = 0; q < s.pairs; ++q) {
      pairs[q].real = in[real.input][real.offset + q * real.slot + b * real.scene];
      if (!(pairs[q].real > T(0))) continue;
      for (int64_t k = 1; k < int64_t(sizeof(Pair<T>) / sizeof(T)); ++k) {
        const Place& p = n.pairs[k];
        ((T*)&pairs[q])[k] = in[p.input][p.offset + q * p.slot + b * p.scene];
      }
      for (int m = 0; m < 4; ++m)
        corners[4 * q + m] = at[n.corner[0] + m * n.corner[1] + q * n.corner[2] + b * n.corner[3]] / n.scenes;
    }
    for (int64_t j = 0; j < s.bodies; ++j)
      for (int64_t k = 0; k < 36; ++k) {
        const Place& p = n.bodies[k];
        inertia[36 * j + k] = in[p.input][p.offset + j * p.slot + b * p.scene];
      }
    scene.slot = slots.data(), scene.points = points.data(), scene.pairs = pairs.data();
    scene.corners = corners.data(), scene.inertia = inertia.data();
    if (n.joints >= 0) scene.joints.numbers = in[n.joints] + b * (9 * s.tied.count + 13 * s.bodies);
  }
};

// Batches stand innermost in what comes out, as in all storage.
template <typename T>
void run(const T* const* in, const int64_t* at, const Inputs& n, T* const* out, const Sizes& s, int threads) {
  const int64_t v = s.slots, scenes = s.scenes, J = 6 * s.bodies, A = 3 * s.tied.count;
  const int64_t counts[13] = {3 * v, v, J, 1, 3 * v, v, 3 * v, 3 * v, J, 1, A, A, J};
#pragma omp parallel num_threads(threads) if (threads > 1 && scenes > 1)
  {
    const FlushTiny flush;
    Scene<T> scene(s);
    Given<T> given(s);
    std::vector<T> found[13];
    for (int r = 0; r < 13; ++r) found[r].resize(counts[r] + 1);
#pragma omp for schedule(dynamic)
    for (int64_t b = 0; b < scenes; ++b) {
      given.read(in, at, n, s, b, scene);
      T* f[13];
      for (int r = 0; r < 13; ++r) f[r] = found[r].data();
      scene(f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8], f[9], f[10], f[11], f[12]);
      for (int r = 0; r < 13; ++r)
        for (int64_t i = 0; i < counts[r]; ++i) out[r][i * scenes + b] = found[r][i];
    }
  }
}

// States and derivatives by results come as (B, ...), derivatives by slots go as (numbers, V, B), those by points, pairs
// and bodies as (B, ..., numbers).
template <typename T>
void back_run(const T* const* in, const int64_t* at, const Inputs& n, const T* const* found, T* const* out, const Sizes& s,
              int threads) {
  const int64_t v = s.slots, scenes = s.scenes, J = 6 * s.bodies;
  constexpr int64_t S = sizeof(Slot<T>) / sizeof(T);
#pragma omp parallel num_threads(threads) if (threads > 1 && scenes > 1)
  {
    const FlushTiny flush;
    Scene<T> scene(s);
    Given<T> given(s);
    std::vector<Slot<T>> slots(v);
#pragma omp for schedule(static, 8)
    for (int64_t b = 0; b < scenes; ++b) {
      given.read(in, at, n, s, b, scene);
      State<T> state{{found[0] + 3 * v * b, found[0] + 3 * v * (b + 1)},
                     {found[1] + v * b, found[1] + v * (b + 1)},
                     {found[2] + J * b, found[2] + J * (b + 1)}};
      std::memset((void*)slots.data(), 0, v * sizeof(Slot<T>));
      scene.backward(state, found[3][b], found[4] + 3 * v * b, found[5] + v * b, found[6] + 3 * v * b,
                     found[7] + 3 * v * b, found[8] + J * b,
                     {slots.data(), (Point<T>*)out[1] + b * s.families * v, (Pair<T>*)out[2] + b * s.pairs, out[3] + 6 * J * b});
      for (int64_t k = 0; k < S; ++k)
        for (int64_t i = 0; i < v; ++i) out[0][(k * v + i) * scenes + b] = ((const T*)&slots[i])[k];
    }
  }
}

}  // namespace

extern "C" {
void touching_float(const float* const* in, const int64_t* at, const Inputs* n, float* const* out, const Sizes* s,
                    int threads) {
  run<float>(in, at, *n, out, *s, threads);
}
void touching_double(const double* const* in, const int64_t* at, const Inputs* n, double* const* out, const Sizes* s,
                     int threads) {
  run<double>(in, at, *n, out, *s, threads);
}
void touching_back_float(const float* const* in, const int64_t* at, const Inputs* n, const float* const* found,
                         float* const* out, const Sizes* s, int threads) {
  back_run<float>(in, at, *n, found, out, *s, threads);
}
void touching_back_double(const double* const* in, const int64_t* at, const Inputs* n, const double* const* found,
                         double* const* out, const Sizes* s, int threads) {
  back_run<double>(in, at, *n, found, out, *s, threads);
}
}
