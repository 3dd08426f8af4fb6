// Numbers of several scenes side by side that remember how they came about, for derivatives backwards.
#pragma once
#include "lanes.h"

#ifndef SIMT
constexpr int TAPED = -1;

template <typename T>
struct Tape {
  struct Node {  // a number with its derivatives by two others
    Lanes<T> da, db;
    int a, b;
  };
  List<Node> nodes;
  List<Lanes<T>> by;  // derivative of the result by each number

  static Tape& on() {
    static thread_local Tape tape;
    return tape;
  }
  void begin() { by.assign(nodes.size(), Lanes<T>{}); }
  // Goes through the numbers from one back to another, which is the last.
  void back(int from, int to) {
    for (int i = from; i-- > to;) {
      const Node& n = nodes[i];
      if (n.a >= 0) by[n.a] += n.da * by[i];
      if (n.b >= 0) by[n.b] += n.db * by[i];
    }
  }
  // Gives memory back that few calls need, after the results are read; what most need is kept for the next.
  void rest() {
    if (nodes.capacity() * (sizeof(Node) + sizeof(Lanes<T>)) < (size_t(1) << 26)) return;
    List<Node>().swap(nodes), List<Lanes<T>>().swap(by);
  }
};

template <typename T>
struct Num<T, TAPED> {
  typedef Lanes<T> L;
  L x;
  int at = -1;  // place on the tape, -1 for constants
  Num() {}
  Num(const L& value) : x(value) {}
  Num(T value) : x(L{} + value) {}
  Num(const L& value, const Num& a, const L& da, const Num& b, const L& db) : x(value) {
    if (a.at < 0 && b.at < 0) return;
    at = int(Tape<T>::on().nodes.size());
    Tape<T>::on().nodes.push_back({da, db, a.at, b.at});
  }
  static Num variable(const L& value, int) {
    Num a(value);
    a.at = int(Tape<T>::on().nodes.size());
    Tape<T>::on().nodes.push_back({L{}, L{}, -1, -1});
    return a;
  }
  L by() const { return at < 0 ? L{} : Tape<T>::on().by[at]; }
  void give(const L& by) const {
    if (at >= 0) Tape<T>::on().by[at] += by;
  }
};

#define TAPE template <typename T> static inline Num<T, TAPED>

TAPE operator+(const Num<T, TAPED>& a, const Num<T, TAPED>& b) {
  const Lanes<T> one = Lanes<T>{} + T(1);
  return {a.x + b.x, a, one, b, one};
}
TAPE operator-(const Num<T, TAPED>& a, const Num<T, TAPED>& b) {
  const Lanes<T> one = Lanes<T>{} + T(1);
  return {a.x - b.x, a, one, b, -one};
}
TAPE operator-(const Num<T, TAPED>& a) { return {-a.x, a, Lanes<T>{} - T(1), T(0), Lanes<T>{}}; }
TAPE operator*(const Num<T, TAPED>& a, const Num<T, TAPED>& b) { return {a.x * b.x, a, b.x, b, a.x}; }
TAPE operator/(const Num<T, TAPED>& a, const Num<T, TAPED>& b) {
  const Lanes<T> inverse = T(1) / b.x, value = a.x / b.x;
  return {value, a, inverse, b, -value * inverse};
}
TAPE root(const Num<T, TAPED>& a) {
  const Lanes<T> value = root<T>(a.x);
  return {value, a, T(0.5) / value, T(0), Lanes<T>{}};
}
template <typename T, typename M>
static inline Num<T, TAPED> select(const M& mask, const Num<T, TAPED>& yes, const Num<T, TAPED>& no) {
  if (!any(mask)) return no;
  if (!any(~mask)) return yes;
  const Lanes<T> zero{}, one = zero + T(1);
  return {mask ? yes.x : no.x, yes, mask ? one : zero, no, mask ? zero : one};
}

// Cosine and sine.
template <typename T>
static inline void turn(const Lanes<T>& angle, Lanes<T>& c, Lanes<T>& s) {
  for (int i = 0; i < WIDTH<T>; ++i) c[i] = std::cos(angle[i]), s[i] = std::sin(angle[i]);
}
template <typename T>
static inline void turn(const Num<T, 0>& angle, Num<T, 0>& c, Num<T, 0>& s) {
  turn<T>(angle.x, c.x, s.x);
}
template <typename T>
static inline void turn(const Num<T, TAPED>& angle, Num<T, TAPED>& c, Num<T, TAPED>& s) {
  Lanes<T> cosine, sine;
  turn<T>(angle.x, cosine, sine);
  c = {cosine, angle, -sine, T(0), Lanes<T>{}}, s = {sine, angle, cosine, T(0), Lanes<T>{}};
}

#endif

// Three numbers, with or without derivatives.
template <typename T, int N>
struct Three {
  typedef Num<T, N> S;
  S x, y, z;
  Three operator+(const Three& o) const { return {x + o.x, y + o.y, z + o.z}; }
  Three operator-(const Three& o) const { return {x - o.x, y - o.y, z - o.z}; }
  Three operator*(const S& k) const { return {x * k, y * k, z * k}; }
  void operator+=(const Three& o) { *this = *this + o; }
  void operator-=(const Three& o) { *this = *this - o; }
  const S& operator[](int k) const { return (&x)[k]; }
};
NUM dot(const Three<T, N>& a, const Three<T, N>& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <typename T, int N>
static inline Three<T, N> cross(const Three<T, N>& a, const Three<T, N>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
// Length, and direction; both zero for zero vectors.
template <typename T, int N>
static inline Num<T, N> measured(const Three<T, N>& a, Three<T, N>& direction) {
  const Num<T, N> squared = dot(a, a), one(T(1));
  const auto zero = squared.x <= TINY<T> * TINY<T>;
  const Num<T, N> length = root(select(zero, one, squared)), inverse = one / length;
  direction = a * inverse;
  return select(zero, Num<T, N>(T(0)), length);
}
