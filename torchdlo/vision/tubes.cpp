// Anti-aliased tubes in pictures, and what their gradients are, for `rasterizer.py`; the formulas stand there.
//
// Every edge writes its patch only; an image keeps for every pixel the edge that covers it most.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

namespace {

template <typename T>
struct Edge {
  T ax, ay, dx, dy, inverse, ra, dr;
  T ux, uy;  // direction, level where there is none
  int64_t first;

  // Signed depth of a pixel below the edge's outline, and the place along the edge that is next to it.
  T depth(T x, T y, T& t, T& radius, T& distance) const {
    const T px = x - ax, py = y - ay;
    t = std::min(std::max((px * dx + py * dy) * inverse, T(0)), T(1));
    const T ox = px - t * dx, oy = py - t * dy;
    distance = std::sqrt(ox * ox + oy * oy);
    radius = ra + t * dr;
    return radius - distance;
  }
};

template <typename T>
constexpr T LEAST = T(1e-7);

// Half of a pixel's width across a line at 45 degrees, and a little.
template <typename T>
constexpr T REACH = T(0.70711);

// The share of a pixel within a straight line at a signed distance: the box's shadow on the line's normal is a
// trapezoid, level over `major - minor` of the normal's components, with flanks as wide as `minor`.
template <typename T>
struct HalfPlane {
  T major, minor, level, half;

  HalfPlane(T nx, T ny)
      : major(std::max(std::abs(nx), std::abs(ny))), minor(std::max(std::min(std::abs(nx), std::abs(ny)), LEAST<T>)),
        level(T(0.5) * (major - minor)), half(T(0.5) * (major + minor)) {}

  T flank(T far) const { return std::min(std::max((half - far) / minor, T(0)), T(1)); }

  T share(T depth) const {
    const T far = std::abs(depth);
    if (far <= level) return T(0.5) + depth / major;
    const T v = flank(far), rest = T(0.5) * minor * v * v / major;
    return depth > 0 ? 1 - rest : rest;
  }

  // Derivatives by depth, by `major` and by `minor`; the last two are added up.
  T slope(T depth, T& by_major, T& by_minor) const {
    const T far = std::abs(depth);
    if (far <= level) {
      by_major -= depth / (major * major);
      return 1 / major;
    }
    const T v = flank(far), sign = depth > 0 ? T(-1) : T(1);
    by_major += sign * T(0.5) * v * (1 - minor * v / major) / major;
    if (minor > LEAST<T>) by_minor += sign * T(0.5) * v * (1 - v) / major;
    return v / major;
  }
};

// The line's normal at a pixel: across the edge beside it, radial on round ends. A quarter turn only swaps components.
template <typename T>
HalfPlane<T> outline(const Edge<T>& e, T t, T ox, T oy, T distance) {
  const bool radial = !(t > 0 && t < 1) && distance > LEAST<T>;
  return radial ? HalfPlane<T>(ox / distance, oy / distance) : HalfPlane<T>(e.ux, e.uy);
}

template <typename T>
struct Image {
  int64_t height, width;
  std::vector<T> depth;
  std::vector<int32_t> winner;
  std::vector<Edge<T>> edges;
  int64_t low, high;  // rows that were touched

  Image(int64_t h, int64_t w) : height(h), width(w), depth(h * w, T(-1)), winner(h * w, -1), low(h), high(0) {}

  void draw(const T* pixel, const T* radius, const uint8_t* real, int64_t vertices, const int64_t* after) {
    std::fill(depth.begin() + std::min(low, high) * width, depth.begin() + high * width, T(-1));
    std::fill(winner.begin() + std::min(low, high) * width, winner.begin() + high * width, -1);
    low = height, high = 0;
    edges.clear();
    for (int64_t k = 0; k < vertices; ++k) {
      const int64_t n = after[k];
      if (n < 0 || !real[k] || !real[n]) continue;
      const T ax = pixel[2 * k], ay = pixel[2 * k + 1], bx = pixel[2 * n], by = pixel[2 * n + 1];
      const T ra = radius[k], rb = radius[n], wide = std::max(ra, rb) + REACH<T>;
      if (!(std::isfinite(ax + ay + bx + by + ra + rb))) continue;
      const T left = std::min(ax, bx) - wide, right = std::max(ax, bx) + wide;
      const T top = std::min(ay, by) - wide, bottom = std::max(ay, by) + wide;
      if (right < 0 || bottom < 0 || left > T(width - 1) || top > T(height - 1)) continue;
      const T dx = bx - ax, dy = by - ay, square = dx * dx + dy * dy;
      const T length = std::sqrt(square);
      const bool some = square > T(1e-18);
      const Edge<T> edge{ax, ay, dx, dy, some ? T(1) / square : T(0), ra, rb - ra, some ? dx / length : T(1),
                         some ? dy / length : T(0), k};
      const int32_t index = int32_t(edges.size());
      edges.push_back(edge);
      const int64_t x0 = std::max<int64_t>(0, int64_t(std::ceil(left)));
      const int64_t x1 = std::min<int64_t>(width - 1, int64_t(std::floor(right)));
      const int64_t y0 = std::max<int64_t>(0, int64_t(std::ceil(top)));
      const int64_t y1 = std::min<int64_t>(height - 1, int64_t(std::floor(bottom)));
      low = std::min(low, y0), high = std::max(high, y1 + 1);
      // A row meets the strip of a slanted edge in an interval.
      const T slack = std::abs(dy) > T(1e-9) ? wide * length / std::abs(dy) : T(0);
      for (int64_t y = y0; y <= y1; ++y) {
        int64_t from = x0, to = x1;
        if (slack > 0) {
          const T middle = ax + (T(y) - ay) * dx / dy;
          // Beyond the ends caps are round: their squares stay within the strip widened by the radius.
          from = std::max<int64_t>(x0, int64_t(std::ceil(std::max(middle - slack, left))));
          to = std::min<int64_t>(x1, int64_t(std::floor(std::min(middle + slack, right))));
        }
        T* row = depth.data() + y * width;
        int32_t* own = winner.data() + y * width;
        for (int64_t x = from; x <= to; ++x) {
          T t, r, distance;
          const T d = edge.depth(T(x), T(y), t, r, distance);
          if (d > row[x]) row[x] = d, own[x] = index;
        }
      }
    }
    high = std::max(high, low < height ? low : int64_t(0));
  }
};

template <typename T>
void forward(const T* pixel, const T* radius, const uint8_t* real, const int64_t* after, int64_t images,
             int64_t vertices, int64_t height, int64_t width, T* out, int threads) {
#pragma omp parallel num_threads(threads)
  {
    Image<T> image(height, width);
#pragma omp for schedule(dynamic)
    for (int64_t n = 0; n < images; ++n) {
      image.draw(pixel + 2 * n * vertices, radius + n * vertices, real + n * vertices, vertices, after);
      T* whole = out + n * height * width;
      for (int64_t y = image.low; y < image.high; ++y) {
        for (int64_t x = 0; x < width; ++x) {
          const int64_t at = y * width + x;
          if (image.winner[at] < 0 || image.depth[at] <= -REACH<T>) continue;
          const Edge<T>& e = image.edges[image.winner[at]];
          T t, r, distance;
          const T d = e.depth(T(x), T(y), t, r, distance), back = 2 * r - d;
          if (d >= REACH<T> && back >= REACH<T>) {
            whole[at] = 1;
            continue;
          }
          const HalfPlane<T> line = outline(e, t, T(x) - e.ax - t * e.dx, T(y) - e.ay - t * e.dy, distance);
          whole[at] = std::min(std::max(line.share(d) + line.share(back) - 1, T(0)), T(1));
        }
      }
    }
  }
}

// Add what a pixel's gradient is to the two vertices of its edge.
template <typename T>
void spread(const Edge<T>& e, T x, T y, T weight, int64_t a, int64_t b, T* p, T* q) {
  T t, r, distance;
  const T d = e.depth(x, y, t, r, distance), back = 2 * r - d;
  if (d >= REACH<T> && back >= REACH<T>) return;
  const T px = x - e.ax, py = y - e.ay, ox = px - t * e.dx, oy = py - t * e.dy;
  const HalfPlane<T> line = outline(e, t, ox, oy, distance);
  const T covered = line.share(d) + line.share(back) - 1;
  if (covered <= 0 || covered >= 1) return;
  T by_major = 0, by_minor = 0;
  const T front = line.slope(d, by_major, by_minor), rear = line.slope(back, by_major, by_minor);
  const T by_depth = (front - rear) * weight, by_radius = 2 * rear * weight;
  const bool inner = t > 0 && t < 1;
  // depth = radius - distance; both change with the place along the edge where that is not at an end.
  const T whole_r = by_depth + by_radius, s = distance > T(1e-12) ? by_depth / distance : T(0);
  T sx = ox * s, sy = oy * s, gx = 0, gy = 0;
  // The normal turns with the edge, or with the pixel's direction from the end; its length stays 1.
  const T mx = inner ? e.ux : ox, my = inner ? e.uy : oy;
  const T size = inner ? (e.inverse > 0 ? std::sqrt(e.inverse) : T(0)) : (distance > LEAST<T> ? 1 / distance : T(0));
  if (size > 0) {
    const bool steep = std::abs(my) > std::abs(mx);
    const T unit = inner ? T(1) : size, vx = mx * unit, vy = my * unit;
    const T wx = weight * (steep ? by_minor : by_major) * (vx < 0 ? T(-1) : T(1));
    const T wy = weight * (steep ? by_major : by_minor) * (vy < 0 ? T(-1) : T(1));
    const T radial = wx * vx + wy * vy;
    gx = (wx - radial * vx) * size, gy = (wy - radial * vy) * size;
  }
  T gax = (1 - t) * sx, gay = (1 - t) * sy, gbx = t * sx, gby = t * sy;
  if (inner) {
    const T along = whole_r * e.dr * e.inverse;
    gbx += along * (px - 2 * t * e.dx) + gx, gby += along * (py - 2 * t * e.dy) + gy;
    gax += along * (2 * t * e.dx - px - e.dx) - gx, gay += along * (2 * t * e.dy - py - e.dy) - gy;
  } else {
    gax -= (1 - t) * gx, gay -= (1 - t) * gy, gbx -= t * gx, gby -= t * gy;
  }
  p[2 * a] += gax, p[2 * a + 1] += gay, p[2 * b] += gbx, p[2 * b + 1] += gby;
  q[a] += (1 - t) * whole_r, q[b] += t * whole_r;
}

template <typename T>
void backward(const T* pixel, const T* radius, const uint8_t* real, const int64_t* after, int64_t images,
              int64_t vertices, int64_t height, int64_t width, const T* gradient, T* to_pixel, T* to_radius,
              int threads) {
#pragma omp parallel num_threads(threads)
  {
    Image<T> image(height, width);
#pragma omp for schedule(dynamic)
    for (int64_t n = 0; n < images; ++n) {
      image.draw(pixel + 2 * n * vertices, radius + n * vertices, real + n * vertices, vertices, after);
      const T* whole = gradient + n * height * width;
      T* p = to_pixel + 2 * n * vertices;
      T* q = to_radius + n * vertices;
      for (int64_t y = image.low; y < image.high; ++y) {
        for (int64_t x = 0; x < width; ++x) {
          const int64_t at = y * width + x;
          if (image.winner[at] < 0 || image.depth[at] <= -REACH<T> || whole[at] == 0) continue;
          const Edge<T>& e = image.edges[image.winner[at]];
          spread(e, T(x), T(y), whole[at], e.first, after[e.first], p, q);
        }
      }
    }
  }
}

}  // namespace

#define KERNELS(NAME, T)                                                                                              \
  extern "C" void tubes_##NAME(const T* pixel, const T* radius, const uint8_t* real, const int64_t* after,            \
                               int64_t images, int64_t vertices, int64_t height, int64_t width, T* out, int threads) { \
    forward(pixel, radius, real, after, images, vertices, height, width, out, threads);                               \
  }                                                                                                                   \
  extern "C" void tubes_gradient_##NAME(const T* pixel, const T* radius, const uint8_t* real, const int64_t* after,   \
                                        int64_t images, int64_t vertices, int64_t height, int64_t width,              \
                                        const T* gradient, T* to_pixel, T* to_radius, int threads) {                  \
    backward(pixel, radius, real, after, images, vertices, height, width, gradient, to_pixel, to_radius, threads);    \
  }

KERNELS(float, float)
KERNELS(double, double)
