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
T coverage(T depth, T radius) {
  return std::min(std::max(std::min(depth, T(0.5)) + std::min(2 * radius - depth, T(0.5)), T(0)), T(1));
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
      const T ra = radius[k], rb = radius[n], wide = std::max(ra, rb) + T(0.5);
      if (!(std::isfinite(ax + ay + bx + by + ra + rb))) continue;
      const T left = std::min(ax, bx) - wide, right = std::max(ax, bx) + wide;
      const T top = std::min(ay, by) - wide, bottom = std::max(ay, by) + wide;
      if (right < 0 || bottom < 0 || left > T(width - 1) || top > T(height - 1)) continue;
      const T dx = bx - ax, dy = by - ay, square = dx * dx + dy * dy;
      const Edge<T> edge{ax, ay, dx, dy, square > T(1e-18) ? T(1) / square : T(0), ra, rb - ra, k};
      const int32_t index = int32_t(edges.size());
      edges.push_back(edge);
      const int64_t x0 = std::max<int64_t>(0, int64_t(std::ceil(left)));
      const int64_t x1 = std::min<int64_t>(width - 1, int64_t(std::floor(right)));
      const int64_t y0 = std::max<int64_t>(0, int64_t(std::ceil(top)));
      const int64_t y1 = std::min<int64_t>(height - 1, int64_t(std::floor(bottom)));
      low = std::min(low, y0), high = std::max(high, y1 + 1);
      // A row meets the strip of a slanted edge in an interval.
      const T length = std::sqrt(square), slack = std::abs(dy) > T(1e-9) ? wide * length / std::abs(dy) : T(0);
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
          if (image.winner[at] < 0 || image.depth[at] <= T(-0.5)) continue;
          T t, r, distance;
          const T d = image.edges[image.winner[at]].depth(T(x), T(y), t, r, distance);
          whole[at] = coverage(d, r);
        }
      }
    }
  }
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
          if (image.winner[at] < 0 || image.depth[at] <= T(-0.5)) continue;
          const Edge<T>& e = image.edges[image.winner[at]];
          T t, r, distance;
          const T d = e.depth(T(x), T(y), t, r, distance);
          const T covered = coverage(d, r);
          if (covered <= 0 || covered >= 1 || whole[at] == 0) continue;
          const bool outer = d < T(0.5), thin = 2 * r - d < T(0.5);
          const T by_depth = (T(outer) - T(thin)) * whole[at], by_radius = 2 * T(thin) * whole[at];
          // depth = radius - distance; both change with the place along the edge where that is not at an end.
          const T whole_r = by_depth + by_radius;
          const T px = T(x) - e.ax, py = T(y) - e.ay, s = distance > T(1e-12) ? by_depth / distance : T(0);
          const T ux = (px - t * e.dx) * s, uy = (py - t * e.dy) * s;
          T gax = (1 - t) * ux, gay = (1 - t) * uy, gbx = t * ux, gby = t * uy;
          if (t > 0 && t < 1 && e.inverse > 0) {
            const T along = whole_r * e.dr * e.inverse;
            gbx += along * (px - 2 * t * e.dx), gby += along * (py - 2 * t * e.dy);
            gax += along * (2 * t * e.dx - px - e.dx), gay += along * (2 * t * e.dy - py - e.dy);
          }
          const int64_t a = e.first, b = after[a];
          p[2 * a] += gax, p[2 * a + 1] += gay, p[2 * b] += gbx, p[2 * b + 1] += gby;
          q[a] += (1 - t) * whole_r, q[b] += t * whole_r;
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
