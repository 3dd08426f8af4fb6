// The equations of an implicit substep of ropes that touch, of one scene, and the search for what solves them.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "touching_parts.h"

namespace {

template <typename T>
class Scene {
 public:
  explicit Scene(const Sizes& sizes)
      : joints{sizes.tied, sizes.bodies}, s(sizes), v(s.slots), n(4 * v), k((s.half + 7) / 8 * 8),
        own(6 * s.bodies + 3 * s.tied.count), before(v), rank(n), y(3 * v), begin(3 * v), along(3 * v),
        push(3 * v), pull(3 * v), turn(3 * v), resist(3 * v), touch(3 * v), between(3 * v), joined(3 * v), residual(3 * v),
        excess(v), lean(v), one(v), two(v), same(v), firm(v), least(v), wrench(6 * s.bodies), step(n),
        load_pos(3 * v), load_length(v), load_body(own), gap(3 * s.tied.count), factors(k), known(s.families * v) {
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

  void backward(State<T>& at, T hard, const T* by_pos, const T* by_tension, const T* by_whole, const T* by_exerted,
                const T* by_held, Parts to);

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
      T fallen = std::numeric_limits<T>::infinity();  // what was left a step ago
      for (int64_t j = 0; j < s.steps[t]; ++j) {
        const State<T> here = now;
        const T rest = newton(now, j >= 2);
        if (j >= 3 && rest < smallest) best = last, kept = chosen, smallest = rest;
        // What falls no further, and is little, is rounding.
        const bool stays = j >= 3 && rest > T(s.law[9]) * fallen && rest < T(s.law[10]) * T(s.law[5]);
        last = here, fallen = rest;
        if (rest < T(s.law[5]) || stays) {
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
  bool law_back(const T* n, T radius, T wanted, T mu, T stiff, const T* moved, const T* u, Moved& to) const;

  static T inner(const T* a, const T* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
  static void cross(const T* a, const T* b, T* to) {
    for (int c = 0; c < 3; ++c) to[c] = a[(c + 1) % 3] * b[(c + 2) % 3] - a[(c + 2) % 3] * b[(c + 1) % 3];
  }
  static void maps_back(const Point<T>& p, const T* g, const T* x, const T* y, const T* z, Point<T>& to);

  void pull_back(const State<T>& now, const std::vector<T>& whole, const std::vector<T>& contact,
                 const std::vector<T>& length, const std::vector<T>& torque, State<T>& by, Parts to);

  void points_back(const State<T>& now, const std::vector<T>& contact, const std::vector<T>& torque, State<T>& by,
                   Parts to);
  void pairs_back(const State<T>& now, const std::vector<T>& contact, State<T>& by, Parts to);
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

  void firm_back(T hard, Parts to);
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
  void transpose();

  void solve(bool transposed);

  template <int K>
  void eliminate(int64_t m);

  void border_out(bool transposed, int64_t extra, int64_t m);

  const Sizes& s;
  const int64_t v, n, k, own;  // own: unknowns of bodies and joints
  std::vector<int64_t> before, rank;
  std::vector<int64_t> places;  // where the entries of `assemble` stand in the band, 28 for each slot
  std::vector<T> y, begin, along, push, pull, turn, resist, touch, between, joined, residual, excess, lean, one, two, same, firm,
      least, wrench, step, band, border, row, corner, side, turned, load_pos, load_length, load_body, gap, levers, reach, other, by_firm,
      by_lean, factors;
  std::vector<Acting> acting;
  std::vector<int64_t> known;  // where the maps of points are, -1 for those that nothing asked for
  std::vector<Maps<T>> maps;
  T scale, share;
};

}  // namespace
