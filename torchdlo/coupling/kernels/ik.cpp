// Inverse kinematics of one chain, pose by pose; formulas and names as in robot/inverse_kinematics.py.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

struct Chain {
  int64_t count, moving, joints, turns;
  const int64_t* mover;
  const double *origin, *turning, *axis, *mix, *shift, *give;
  double lever, still;
};

struct Search {
  int64_t steps, closing, polish;
  double pull, stride, near, aligned;
};

// What is known at joint positions, and room to work in.
struct Here {
  double pos[3], quat[4], error[6], missing[2];
  std::vector<double> moving, slope;  // of moving and of commanded joints, 6 rows each
};

typedef std::vector<double> Row;

static void cross(const double* a, const double* b, double* to) {
  to[0] = a[1] * b[2] - a[2] * b[1];
  to[1] = a[2] * b[0] - a[0] * b[2];
  to[2] = a[0] * b[1] - a[1] * b[0];
}

static double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void times(const double* a, const double* b, double* to) {
  double out[9];
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) out[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
  std::copy(out, out + 9, to);
}

// Shepperd's method, see `from_matrix` in common/pose.py.
static void quaternion(const double* m, double* to) {
  const double x = m[0], y = m[4], z = m[8];
  const double a = m[7] - m[5], b = m[2] - m[6], c = m[3] - m[1], d = m[3] + m[1], e = m[2] + m[6], f = m[5] + m[7];
  const double rows[4][4] = {
      {1 + x + y + z, a, b, c}, {a, 1 + x - y - z, d, e}, {b, d, 1 - x + y - z, f}, {c, e, f, 1 - x - y + z}};
  int best = 0;
  for (int k = 1; k < 4; k++)
    if (rows[k][k] > rows[best][best]) best = k;
  const double* row = rows[best];
  const double size = std::sqrt(row[0] * row[0] + row[1] * row[1] + row[2] * row[2] + row[3] * row[3]);
  for (int k = 0; k < 4; k++) to[k] = row[k] / size;
}

// The rotation vector from one quaternion to another the short way, see `turn_between` in bodies/dynamics.py.
static void turn_between(const double* start, const double* end, double* to) {
  const double back[3] = {-start[1], -start[2], -start[3]}, w = end[0] * start[0] - dot(end + 1, back);
  double across[3];
  cross(end + 1, back, across);
  const double sign = w < 0 ? -1.0 : 1.0;
  double v[3];
  for (int k = 0; k < 3; k++) v[k] = sign * (end[0] * back[k] + start[0] * end[1 + k] + across[k]);
  const double sine = std::sqrt(dot(v, v));
  const double scale = sine < 1e-4 ? 2 + sine * sine / 3 : 2 * std::atan2(sine, sign * w) / sine;
  for (int k = 0; k < 3; k++) to[k] = scale * v[k];
}

static void look(const Chain& chain, const double* target, const double* q, Here& here, Row& places) {
  const int64_t m = chain.moving, n = chain.joints;
  double turn[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1}, *p = here.pos;
  std::fill(p, p + 3, 0.0);
  std::fill(here.moving.begin(), here.moving.end(), 0.0);
  for (int64_t k = 0; k < chain.count; k++) {
    const double* origin = chain.origin + 12 * k;
    for (int i = 0; i < 3; i++) p[i] += dot(turn + 3 * i, origin + 9);
    times(turn, origin, turn);
    const int64_t at = chain.mover[k];
    if (at < 0) continue;
    double value = chain.shift[at], *place = &places[6 * at];
    for (int64_t j = 0; j < n; j++) value += chain.mix[at * n + j] * q[j];
    const double* axis = chain.axis + 3 * at;
    for (int i = 0; i < 3; i++) {
      place[i] = dot(turn + 3 * i, axis);
      place[3 + i] = p[i];
    }
    if (chain.turning[at] > 0) {
      const double c = std::cos(value), s = std::sin(value), x = axis[0], y = axis[1], z = axis[2], u = 1 - c;
      const double spin[9] = {c + u * x * x,     u * x * y - s * z, u * x * z + s * y, u * x * y + s * z, c + u * y * y,
                              u * y * z - s * x, u * x * z - s * y, u * y * z + s * x, c + u * z * z};
      times(turn, spin, turn);
    } else {
      for (int i = 0; i < 3; i++) p[i] += value * place[i];
    }
  }
  quaternion(turn, here.quat);
  double off[3];
  turn_between(here.quat, target + 3, off);
  for (int i = 0; i < 3; i++) {
    here.error[i] = target[i] - p[i];
    here.error[3 + i] = chain.turns ? chain.lever * off[i] : 0.0;
  }
  here.missing[0] = std::sqrt(dot(here.error, here.error));
  here.missing[1] = std::sqrt(dot(here.error + 3, here.error + 3)) / chain.lever;
  for (int64_t k = 0; k < chain.count; k++) {
    const int64_t at = chain.mover[k];
    if (at < 0) continue;
    const double *axis = &places[6 * at], arm[3] = {p[0] - axis[3], p[1] - axis[4], p[2] - axis[5]};
    double linear[3];
    cross(axis, arm, linear);
    for (int i = 0; i < 3; i++) {
      const bool turning = chain.turning[at] > 0;
      here.moving[i * m + at] = turning ? linear[i] : axis[i];
      here.moving[(3 + i) * m + at] = turning && chain.turns ? chain.lever * axis[i] : 0.0;
    }
  }
  for (int64_t i = 0; i < 6; i++)
    for (int64_t j = 0; j < n; j++) {
      double sum = 0;
      for (int64_t k = 0; k < m; k++) sum += here.moving[i * m + k] * chain.mix[k * n + j];
      here.slope[i * n + j] = sum;
    }
}

// Solve a system of n with c right-hand sides in place, by elimination with pivots in columns.
static void solve(double* a, double* b, int64_t n, int64_t c) {
  for (int64_t k = 0; k < n; k++) {
    int64_t best = k;
    for (int64_t i = k + 1; i < n; i++)
      if (std::abs(a[i * n + k]) > std::abs(a[best * n + k])) best = i;
    if (best != k) {
      std::swap_ranges(a + k * n, a + k * n + n, a + best * n);
      std::swap_ranges(b + k * c, b + k * c + c, b + best * c);
    }
    for (int64_t i = k + 1; i < n; i++) {
      const double factor = a[i * n + k] / a[k * n + k];
      if (factor == 0) continue;
      for (int64_t j = k + 1; j < n; j++) a[i * n + j] -= factor * a[k * n + j];
      for (int64_t j = 0; j < c; j++) b[i * c + j] -= factor * b[k * c + j];
    }
  }
  for (int64_t k = n - 1; k >= 0; k--)
    for (int64_t j = 0; j < c; j++) {
      double sum = b[k * c + j];
      for (int64_t i = k + 1; i < n; i++) sum -= a[k * n + i] * b[i * c + j];
      b[k * c + j] = sum / a[k * n + k];
    }
}

struct Problem {
  const Chain& chain;
  const double *target, *posture, *lower, *upper;
  Row places, wish, give, change, square, whole, columns, half;
  std::vector<char> held;
  int64_t n;
  double mean = 0;

  explicit Problem(const Chain& c)
      : chain(c), places(6 * c.moving), wish(c.joints), give(c.joints), change(c.joints), square(36),
        whole((c.joints + 6) * (c.joints + 6)), columns(7 * (c.joints + 6)), half(c.joints), held(c.joints),
        n(c.joints) {
    for (int64_t j = 0; j < n; j++) {
      half[j] = std::sqrt(c.give[j]);
      mean += c.give[j] / double(n);
    }
  }

  double damping(const Here& here) const {
    double sum = 0;
    for (double e : here.error) sum += e * e;
    return (0.5 * sum + chain.still) * mean;
  }

  bool stopped(int64_t j, double q, double change) const {
    const double rounding = 1e3 * std::numeric_limits<double>::epsilon() * half[j];
    return (q <= lower[j] + rounding && change < 0) || (q >= upper[j] - rounding && change > 0);
  }

  void limit(Row& change, double stride) const {
    double most = 0;
    for (int64_t j = 0; j < n; j++) most = std::max(most, std::abs(change[j]) / (half[j] > 0 ? half[j] : 1.0));
    const double share = stride > 0 ? stride / std::max(most, stride) : 0.0;
    for (double& x : change) x *= share;
  }

  // (J G J^T + m)^-1 times a vector of 6, in place.
  void push(const Here& here, const Row& give, double m, double* vector) {
    for (int64_t i = 0; i < 6; i++)
      for (int64_t k = 0; k < 6; k++) {
        double sum = i == k ? m : 0.0;
        for (int64_t j = 0; j < n; j++) sum += here.slope[i * n + j] * give[j] * here.slope[k * n + j];
        square[6 * i + k] = sum;
      }
    solve(square.data(), vector, 6, 1);
  }

  void damped(const Here& here, const double* q, double pull, double stride) {
    const double m = damping(here);
    for (int64_t j = 0; j < n; j++) wish[j] = chain.give[j] > 0 ? 0.5 * (posture[j] - q[j]) : 0.0;
    limit(wish, pull);
    std::copy(chain.give, chain.give + n, give.begin());
    for (int pass = 0; pass < 2; pass++) {
      double left[6];
      for (int64_t i = 0; i < 6; i++) {
        left[i] = here.error[i];
        for (int64_t j = 0; j < n; j++) left[i] -= here.slope[i * n + j] * wish[j];
      }
      push(here, give, m, left);
      for (int64_t j = 0; j < n; j++) {
        double sum = 0;
        for (int64_t i = 0; i < 6; i++) sum += here.slope[i * n + j] * left[i];
        change[j] = wish[j] + give[j] * sum;
      }
      if (pass == 0)
        for (int64_t j = 0; j < n; j++)
          if (stopped(j, q[j], change[j])) wish[j] = give[j] = 0;
    }
    limit(change, stride);
  }

  // The change of a Newton step, and how it follows the error in `columns`: row j, columns 1 to 6.
  void newton(const Here& here, const double* q) {
    const int64_t size = n + 6, m = chain.moving;
    const double small = damping(here);
    std::fill(held.begin(), held.end(), 0);
    for (int pass = 0; pass < 2; pass++) {
      for (int64_t j = 0; j < n; j++) {
        const bool free = chain.give[j] > 0 && !held[j];
        give[j] = free ? chain.give[j] : 0.0;
        wish[j] = free ? posture[j] - q[j] : 0.0;
      }
      double force[6];
      for (int64_t i = 0; i < 6; i++) {
        force[i] = 0;
        for (int64_t j = 0; j < n; j++) force[i] += here.slope[i * n + j] * wish[j];
      }
      push(here, give, small, force);
      std::fill(whole.begin(), whole.end(), 0.0);
      bend(here, force, m);
      std::fill(columns.begin(), columns.end(), 0.0);
      for (int64_t i = 0; i < n; i++) {
        const bool free = give[i] > 0;
        for (int64_t j = 0; j < n; j++)
          if (!free || !(give[j] > 0)) whole[i * size + j] = 0;
        whole[i * size + i] += free ? 1 / chain.give[i] : 1.0;
        double pull = free ? wish[i] / chain.give[i] : 0.0;
        for (int64_t k = 0; k < 6; k++) {
          const double on = free ? here.slope[k * n + i] : 0.0;
          whole[i * size + n + k] = whole[(n + k) * size + i] = on;
          pull -= on * force[k];
        }
        columns[7 * i] = pull;
      }
      for (int64_t k = 0; k < 6; k++) {
        whole[(n + k) * size + n + k] = -small;
        columns[7 * (n + k) + 1 + k] = 1;
      }
      solve(whole.data(), columns.data(), size, 7);
      for (int64_t j = 0; j < n; j++) {
        change[j] = columns[7 * j];
        for (int64_t k = 0; k < 6; k++) change[j] += columns[7 * j + 1 + k] * here.error[k];
        if (pass == 0) held[j] = stopped(j, q[j], change[j]);
      }
    }
  }

  // The derivative of J^T f by the joints for a fixed f, see `_bending`, into `whole`.
  void bend(const Here& here, const double* force, int64_t m) {
    const int64_t size = n + 6;
    const double turn[3] = {chain.lever * force[3], chain.lever * force[4], chain.lever * force[5]};
    for (int64_t a = 0; a < m; a++) {
      double w[3], across[3], about[3];
      for (int i = 0; i < 3; i++) w[i] = here.moving[(3 + i) * m + a] / chain.lever;
      cross(force, w, across);
      cross(turn, w, about);
      for (int64_t b = a; b < m; b++) {
        double up = 0, down = 0;
        for (int i = 0; i < 3; i++) {
          up += across[i] * here.moving[i * m + b];
          down += about[i] * here.moving[(3 + i) * m + b] / chain.lever;
        }
        for (int64_t i = 0; i < n; i++)
          for (int64_t j = 0; j < n; j++) {
            whole[i * size + j] += chain.mix[a * n + i] * up * chain.mix[b * n + j];
            if (b > a) whole[i * size + j] += chain.mix[b * n + i] * (up + down) * chain.mix[a * n + j];
          }
      }
    }
  }

  bool reached(const Here& here, const Search& search) const {
    return here.missing[0] <= search.near && here.missing[1] <= search.aligned;
  }
};

static double norm(const double* error) {
  double sum = 0;
  for (int i = 0; i < 6; i++) sum += error[i] * error[i];
  return std::sqrt(sum);
}

static double bounded(double x, double low, double high) { return std::min(std::max(x, low), high); }

static void descend(Problem& to, const Search& search, double* q, Here& here, Here& seen, Row& there) {
  const Chain& chain = to.chain;
  const int64_t n = to.n;
  for (int64_t k = 0; k < search.steps + search.closing; k++) {
    look(chain, to.target, q, here, to.places);
    to.damped(here, q, k < search.steps ? search.pull : 0.0, search.stride);
    for (int64_t j = 0; j < n; j++) q[j] = bounded(q[j] + to.change[j], to.lower[j], to.upper[j]);
  }
  look(chain, to.target, q, here, to.places);
  for (int64_t k = 0; k < search.polish; k++) {
    to.newton(here, q);
    to.limit(to.change, 2 * search.pull);
    for (int64_t j = 0; j < n; j++) there[j] = bounded(q[j] + to.change[j], to.lower[j], to.upper[j]);
    look(chain, to.target, there.data(), seen, to.places);
    if (!to.reached(seen, search) && !(norm(seen.error) < norm(here.error))) continue;
    std::copy(there.begin(), there.end(), q);
    std::swap(here, seen);
  }
}

// Joints (B, J) are moved in place; `out` (B, 8 + 12 J) gets where the tool then is (position, quaternion), how far the
// next Newton step goes, how the tool moves with the joints (6, J), and how that step follows the error (J, 6).
extern "C" void ik_double_solve(const Chain* chain, const Search* search, const double* target, const double* posture,
                                const double* lower, const double* upper, double* joints, double* out, int64_t batch,
                                int threads) {
  const int64_t n = chain->joints, width = 8 + 12 * n;
#pragma omp parallel num_threads(int(std::max<int64_t>(1, std::min<int64_t>(threads, batch / 8))))
  {
    Problem to(*chain);
    Here here, seen;
    Row there(n);
    for (Here* x : {&here, &seen}) {
      x->moving.resize(6 * chain->moving);
      x->slope.resize(6 * n);
    }
#pragma omp for
    for (int64_t k = 0; k < batch; k++) {
      double *q = joints + k * n, *row = out + k * width;
      to.target = target + 7 * k;
      to.posture = posture + k * n;
      to.lower = lower + k * n;
      to.upper = upper + k * n;
      descend(to, *search, q, here, seen, there);
      to.newton(here, q);
      std::copy(here.pos, here.pos + 3, row);
      std::copy(here.quat, here.quat + 4, row + 3);
      row[7] = 0;
      for (int64_t j = 0; j < n; j++)  // what is no number stays none
        if (!(std::abs(to.change[j]) <= row[7]) && row[7] == row[7]) row[7] = std::abs(to.change[j]);
      std::copy(here.slope.begin(), here.slope.end(), row + 8);
      for (int64_t j = 0; j < n; j++)
        for (int64_t i = 0; i < 6; i++) row[8 + 6 * n + 6 * j + i] = to.columns[7 * j + 1 + i];
    }
  }
}
