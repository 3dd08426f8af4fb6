// Positions and tensions of one implicit substep by Newton's method.
//
// The formulas stand in constrain.py (`balance`, `Inertia`, `Lengths`), as tensor operations.
#pragma once
#include "rods.h"

namespace {

template <typename T>
class Balance {
 public:
  struct In {
    Lanes<T> rest, compliance, active, mask, give, hinge, swing, free, tension;
    Vec<T> vertex, moved, force, start, lead;
    Lanes<T> scale;
  };

  Balance(const Call& call, Scratch<T>& scratch) : s(call), v(call.slots), before(preceding(call)) {
    for (Vec<T>** x : {&pos, &y, &along, &begin, &start, &push, &pull, &turn, &moment, &resist})
      *x = scratch.template take<Vec<T>>(v);
    for (Lanes<T>** x : {&lean, &centre, &same, &one, &two, &string, &impulse, &excess}) *x = scratch.take(v);
    entries = scratch.take(20 * v);
    rhs = scratch.take(4 * v);
    found = scratch.take(4 * v);
    work = scratch.take((4 * v + s.half) * (2 * s.half + 2));
  }

  // Positions, tensions, and forces.
  void operator()(const In* given, const Out<T>& out) {
    slot = given;
    scale = slot[0].scale;
    begin_with();
    const Lanes<T> zero{};
    open = zero + T(1);
    for (int64_t k = 0; k < s.numbers[4]; ++k) {
      newton();
      // Scenes are done one by one: what they find does not depend on those beside them.
      open = changed < T(s.numbers[5]) ? zero : open;
      bool any = false;
      for (int j = 0; j < WIDTH<T>; ++j) any |= open[j] != T(0);
      if (!any) break;
    }
    open = zero + T(1);
    const bool whole = s.numbers[6] != 0;
    for (int64_t i = 0; i < v; ++i)
      for (int c = 0; c < 3; ++c) {
        Lanes<T>& x = part(pos[i], c);
        x = slot[i].free > T(0) ? x : part(slot[i].moved, c);
      }
    if (whole) newton(), residual();
    for (int64_t i = 0; i < v; ++i) {
      out.put(0, i, pos[i]);
      out.put(3, i, impulse[i] / scale);
      if (whole) out.put(4, i, push[i] * (T(1) / scale));
    }
  }

 private:
  static Lanes<T>& part(Vec<T>& x, int c) { return (&x.x)[c]; }
  static const Lanes<T>& part(const Vec<T>& x, int c) { return (&x.x)[c]; }

  void begin_with() {
    const T turning = T(s.numbers[0]), pressed = T(s.numbers[2]);
    for (int64_t i = 0; i < v; ++i) {
      const In& p = slot[i];
      lean[i] = turning * p.active / p.rest;
      start[i] = p.start + p.lead * p.active;
      // A straight rope pressed along its line leaves tensions of any size: no first guess.
      const Lanes<T> least = -pressed * p.rest / p.give;
      impulse[i] = (p.tension < least ? Lanes<T>{} : p.tension) * p.active * scale;
      pos[i] = p.moved;
    }
    bands();
  }

  void bands() {
    for (int64_t i = 0; i < v; ++i) {
      const int64_t p = before[i];
      centre[i] = slot[i].mask / slot[i].rest + slot[p].mask / slot[p].rest;
    }
    for (int64_t i = 0; i < v; ++i) {
      const int64_t n = s.after[i], p = before[i];
      const Lanes<T> after = slot[i].mask / slot[i].rest, next = slot[n].mask / slot[n].rest;
      one[i] = -slot[i].hinge * centre[i] * after - slot[n].hinge * after * centre[n] - slot[i].swing;
      two[i] = slot[n].hinge * after * next;
      const Lanes<T> last = slot[p].mask / slot[p].rest;
      same[i] = slot[i].hinge * centre[i] * centre[i] + slot[n].hinge * after * after + slot[p].hinge * last * last +
                slot[i].swing + slot[p].swing;
    }
  }
  Lanes<T> yielding(int64_t i) const { return T(s.numbers[1]) * slot[i].rest / slot[i].give; }

  void residual() {
    for (int64_t i = 0; i < v; ++i) y[i] = pos[i] - slot[i].moved;
    for (int64_t i = 0; i < v; ++i) {
      const In& p = slot[i];
      const int64_t n = s.after[i];
      const Vec<T> turned = y[n] - y[i];
      begin[i] = start[i] + turned * lean[i];
      pull[i] = begin[i] * impulse[i] + turned * p.swing;
      turn[i] = turned * (p.mask / p.rest);
      const Vec<T> e = edge(pos[i], pos[n], p.mask);
      const Lanes<T> size = length(e);
      along[i] = e * (T(1) / at_least<T>(size, T(1e-12)));
      const Lanes<T> tension = impulse[i] / scale, beyond = tension - yielding(i);
      excess[i] = (size - p.rest - p.compliance * tension - p.give * (beyond > T(0) ? beyond : Lanes<T>{})) * p.active;
    }
    for (int64_t i = 0; i < v; ++i) moment[i] = (turn[i] - turn[before[i]]) * slot[i].hinge;
    for (int64_t i = 0; i < v; ++i)
      resist[i] = (moment[i] - moment[s.after[i]]) * (slot[i].mask / slot[i].rest);
    for (int64_t i = 0; i < v; ++i) {
      const int64_t p = before[i];
      push[i] = slot[i].force * scale + pull[i] - pull[p] - resist[p] + resist[i];
    }
  }

  void newton() {
    residual();
    const Lanes<T> zero{};
    for (int64_t i = 0; i < v; ++i) string[i] = impulse[i] * lean[i];
    Lanes<T>* e = entries;
    for (int64_t i = 0; i < v; ++i) {
      const In& p = slot[i];
      const int64_t n = s.after[i], b = before[i];
      const Lanes<T> own = p.free * (same[i] + string[i] + string[b]);
      const Lanes<T> pressed = p.free * p.active, onward = slot[n].free * p.active;
      e[3 * v + i] = p.free * (one[i] - string[i]);
      e[4 * v + i] = p.free * (one[b] - string[b]);
      e[5 * v + i] = p.free * two[i];
      e[6 * v + i] = p.free * two[before[b]];
      for (int c = 0; c < 3; ++c) {
        e[c * v + i] = part(slot[i].vertex, c) + own;
        e[(7 + c) * v + i] = -pressed * part(begin[i], c);
        e[(10 + c) * v + i] = onward * part(begin[i], c);
        e[(13 + c) * v + i] = -p.active * part(along[i], c);
        e[(16 + c) * v + i] = p.active * part(along[i], c);
        rhs[c * v + i] = p.free * part(push[i], c) - part(slot[i].vertex, c) * part(y[i], c);
      }
      const Lanes<T> soft = impulse[i] / scale > yielding(i) ? p.give : zero;
      e[19 * v + i] = -p.active * (p.compliance + soft + T(s.numbers[3]) * p.give) / scale + (p.active - T(1));
      rhs[3 * v + i] = -excess[i];
    }
    eliminate();
    Lanes<T> most{}, stiffest{};
    for (int64_t i = 0; i < v; ++i) {
      const int64_t n = s.after[i];
      // How much the string's part of the matrix changes, over what it is.
      const Lanes<T> pulled = lean[i] * found[3 * v + i], string_now = lean[i] * impulse[i];
      const Lanes<T> firm = slot[i].vertex.x + (string_now < T(0) ? -string_now : string_now);
      const Lanes<T> ratio = (pulled < T(0) ? -pulled : pulled) / firm;
      stiffest = ratio > stiffest ? ratio : stiffest;
      Lanes<T> squared{};
      for (int c = 0; c < 3; ++c) {
        const Lanes<T> turned = slot[i].active * (found[c * v + n] - found[c * v + i]) / slot[i].rest;
        squared += turned * turned;
      }
      most = squared > most ? squared : most;
    }
    most = root<T>(most);
    // An edge may turn by about one radian at a time.
    const Lanes<T> share = open * (most > T(1) ? T(1) / most : zero + T(1));
    changed = most > stiffest ? most : stiffest;
    for (int64_t i = 0; i < v; ++i) {
      for (int c = 0; c < 3; ++c) part(pos[i], c) += share * found[c * v + i];
      impulse[i] += share * found[3 * v + i];
    }
  }

  void eliminate() {
    const T *e = (const T*)entries, *r = (const T*)rhs;
    const int n = 4 * (int)v, k = (int)s.half, count = (int)s.count;
    constexpr int W = WIDTH<T>;
    // Open ropes have k = 8.
    if (k == 8) solve_lanes<T, Lanes<T>, 8>(e, s.pattern, count, s.order, r, (T*)found, n, k, W, 0, W, work);
    else solve_lanes<T, Lanes<T>, 0>(e, s.pattern, count, s.order, r, (T*)found, n, k, W, 0, W, work);
  }

  const Call& s;
  const int64_t v;
  std::vector<int64_t> before;
  const In* slot = nullptr;
  Vec<T> *pos, *y, *along, *begin, *start, *push, *pull, *turn, *moment, *resist;
  Lanes<T> *lean, *centre, *same, *one, *two, *string, *impulse, *excess, *entries, *rhs, *found, *work;
  Lanes<T> scale, open, changed;
};

}  // namespace
