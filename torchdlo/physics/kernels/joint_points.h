// Points of ropes that are joined to free bodies or other ropes; formulas and names as in joint_points.py.
#pragma once
#include <cmath>
#include <cstdint>

// The static side: `count` points, whose vertices and weights stand behind each other from `first` on, and their bodies.
struct Tied {
  int64_t count;
  const int64_t *first, *slot, *body;
  const double* weight;
};

// A body's orientation after a step without torque, and how it turns with its angular velocity, see `spin_freely` and
// `spin_gradient` in linalg/free_rotation.py.
template <typename T>
struct Spin {
  T quat[4], turn[9];

  static void axes(const T* q, T* to) {  // rows: the axes of the body in the world
    const T w = q[0], x = q[1], y = q[2], z = q[3];
    const T r[9] = {1 - 2 * (y * y + z * z), 2 * (x * y + w * z),     2 * (x * z - w * y),
                    2 * (x * y - w * z),     1 - 2 * (x * x + z * z), 2 * (y * z + w * x),
                    2 * (x * z + w * y),     2 * (y * z - w * x),     1 - 2 * (x * x + y * y)};
    for (int i = 0; i < 9; ++i) to[i] = r[i];
  }

  void world(const T* local, T* to) const {
    T r[9];
    axes(quat, r);
    for (int c = 0; c < 3; ++c) to[c] = r[c] * local[0] + r[3 + c] * local[1] + r[6 + c] * local[2];
  }

  Spin(const T* start, const T* inertia, const T* omega, T dt) {
    T inward[9], p[3], change[9], way[9] = {};
    axes(start, inward);
    for (int i = 0; i < 3; ++i) {
      p[i] = 0;
      for (int c = 0; c < 3; ++c) {
        change[3 * i + c] = inertia[i] * inward[3 * i + c];
        p[i] += change[3 * i + c] * omega[c];
      }
    }
    for (int i = 0; i < 4; ++i) quat[i] = start[i];
    const int order[5] = {0, 1, 2, 1, 0};
    for (int n = 0; n < 5; ++n) {
      const int a = order[n], j = (a + 1) % 3, k = (a + 2) % 3;
      const T time = (n == 2 ? T(1) : T(0.5)) * dt / inertia[a], angle = time * p[a];
      T c = std::cos(angle), s = std::sin(angle);
      const T one = c * p[j] + s * p[k], two = c * p[k] - s * p[j];
      p[j] = one, p[k] = two;
      for (int i = 0; i < 3; ++i) {
        const T more = time * change[3 * a + i], cj = change[3 * j + i], ck = change[3 * k + i];
        const T wj = way[3 * j + i], wk = way[3 * k + i];
        change[3 * j + i] = c * cj + s * ck + two * more, change[3 * k + i] = c * ck - s * cj - one * more;
        way[3 * j + i] = c * wj + s * wk, way[3 * k + i] = c * wk - s * wj;
        way[3 * a + i] += more;
      }
      c = std::cos(angle / 2), s = std::sin(angle / 2);
      const T w = quat[0], own = quat[1 + a], left = quat[1 + j], right = quat[1 + k];
      quat[0] = w * c - own * s, quat[1 + a] = own * c + w * s;
      quat[1 + j] = left * c + right * s, quat[1 + k] = right * c - left * s;
    }
    T size = 0;
    for (T x : quat) size += x * x;
    for (T& x : quat) x /= std::sqrt(size);
    T out[9];
    axes(quat, out);
    for (int i = 0; i < 3; ++i)
      for (int c = 0; c < 3; ++c) {
        turn[3 * i + c] = 0;
        for (int m = 0; m < 3; ++m) turn[3 * i + c] += out[3 * m + i] * way[3 * m + c];
      }
  }
};

// The joints of a scene, and what they are at a state.
template <typename T>
struct Joints {
  const Tied& tied;
  const int64_t bodies;
  const T* numbers = nullptr;  // local, arm and force of points; place, orientation, inertia and spin of bodies

  const T* local(int64_t a) const { return numbers + 3 * a; }
  const T* arm(int64_t a) const { return numbers + 3 * (tied.count + a); }
  const T* force(int64_t a) const { return numbers + 3 * (2 * tied.count + a); }
  const T* of_bodies() const { return numbers + 9 * tied.count; }

  Spin<T> spin(int64_t b, const T* moved, T dt) const {
    const T *quat = of_bodies() + 3 * bodies + 4 * b, *inertia = of_bodies() + 7 * bodies + 3 * b;
    T omega[3];
    for (int c = 0; c < 3; ++c) omega[c] = of_bodies()[10 * bodies + 3 * b + c] + moved[3 + c] / dt;
    return Spin<T>(quat, inertia, omega, dt);
  }

  // By how far a point misses its place; with `matrix`, (3, 6), how its place moves with the body.
  void gap(int64_t a, const T* pos, const T* moved, T dt, T* to, T* matrix) const {
    for (int c = 0; c < 3; ++c) to[c] = 0;
    for (int64_t q = tied.first[a]; q < tied.first[a + 1]; ++q)
      for (int c = 0; c < 3; ++c) to[c] += T(tied.weight[q]) * pos[3 * tied.slot[q] + c];
    const int64_t b = tied.body[a];
    if (b < 0) return;
    const Spin<T> end = spin(b, moved + 6 * b, dt);
    T r[3];
    end.world(local(a), r);
    for (int c = 0; c < 3; ++c) to[c] -= of_bodies()[3 * b + c] + moved[6 * b + c] + r[c];
    if (!matrix) return;
    for (int c = 0; c < 3; ++c) {
      const int d = (c + 1) % 3, e = (c + 2) % 3;
      for (int m = 0; m < 3; ++m) {
        matrix[6 * c + m] = T(c == m);
        matrix[6 * c + 3 + m] = (end.turn[3 * d + m] * r[e] - end.turn[3 * e + m] * r[d]) / dt;
      }
    }
  }
};
