// The derivative of an implicit substep of ropes that touch, by all that it is made of.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "touching_scene.h"

namespace {

// Adds the derivative of results by all that the scene is made of.
//
// The exact step from a state x makes x' = x - share K^-1 R(x), in which x and K are constant: held vertices are where
// they have to be, and impulses are tensions times `scale`. Results depend on x' and on what the scene is made of.
template <typename T>
void Scene<T>::backward(State<T>& at, T hard, const T* by_pos, const T* by_tension, const T* by_whole,
                        const T* by_exerted, const T* by_held, Parts to) {
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

template <typename T>
bool Scene<T>::law_back(const T* n, T radius, T wanted, T mu, T stiff, const T* moved, const T* u, Moved& to) const {
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

// Adds the derivative of g . `Maps` (x, y, z) by the point.
template <typename T>
void Scene<T>::maps_back(const Point<T>& p, const T* g, const T* x, const T* y, const T* z, Point<T>& to) {
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
template <typename T>
void Scene<T>::pull_back(const State<T>& now, const std::vector<T>& whole, const std::vector<T>& contact,
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

template <typename T>
void Scene<T>::points_back(const State<T>& now, const std::vector<T>& contact, const std::vector<T>& torque, State<T>&
                           by, Parts to) {
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

template <typename T>
void Scene<T>::pairs_back(const State<T>& now, const std::vector<T>& contact, State<T>& by, Parts to) {
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

// Adds the derivative by what `prepare` made the stiffness of.
template <typename T>
void Scene<T>::firm_back(T hard, Parts to) {
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

}  // namespace
