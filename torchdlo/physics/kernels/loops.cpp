// The operations of a recorded step, one loop after another without leaving this file: between small tensors that is
// what takes the time. Each loop does what the tensor operation of the same name does.

#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>

namespace {

constexpr int DIMS = 4;

#define OPERATIONS(X)                                                                                               \
  X(kernel) X(copy) X(where) X(gather) X(add) X(sub) X(mul) X(div) X(minimum) X(maximum) X(clamp_min) X(clamp_max)    \
  X(atan2) X(pow) X(lerp) X(neg) X(abs) X(sqrt) X(square) X(reciprocal) X(round) X(floor) X(sign) X(exp) X(log) X(sin)        \
  X(cos) X(tanh) X(asin) X(expm1) X(eq) X(ne) X(lt) X(le) X(gt) X(ge) X(from_bool) X(cumsum) X(logical_and)              \
  X(logical_or) X(logical_xor) X(logical_not)

enum class What : int64_t {
#define ENTRY(name) name,
  OPERATIONS(ENTRY)
#undef ENTRY
};

constexpr const char* NAMES[] = {
#define ENTRY(name) #name,
    OPERATIONS(ENTRY) nullptr
#undef ENTRY
};

// Where numbers are: bytes behind the start of a buffer, and how many of their own from one to the next.
struct Place {
  int64_t buffer, offset, stride[DIMS];
};

struct Loop {
  What what;
  int64_t kind, size[DIMS];
  Place out, in[3];
  double number;         // factor of the second operand of `add` and `sub`, weight of `lerp`
  const int64_t* rows;   // of `gather`: rows of the input along the third dimension
  void (*run)(void*, void*, void*, int);  // of `kernel`: another kernel, its description, and where its inputs are
  void* call;
  const Place* given;
  int64_t count;
};

// Walks dimensions other than the last one by one: `f` is given where each row of numbers begins.
template <int N, class F>
void rows(const Loop& l, char** base, const int64_t (&width)[N], const Place* const (&place)[N], F f) {
  char* at[N];
  for (int n = 0; n < N; n++) at[n] = base[place[n]->buffer] + place[n]->offset;
  for (int64_t i = 0; i < l.size[0]; i++)
    for (int64_t j = 0; j < l.size[1]; j++)
      for (int64_t k = 0; k < l.size[2]; k++) {
        char* here[N];
        for (int n = 0; n < N; n++) {
          const int64_t* s = place[n]->stride;
          here[n] = at[n] + width[n] * (i * s[0] + j * s[1] + k * s[2]);
        }
        f(here);
      }
}

template <class O, class A, class F>
void unary(const Loop& l, char** base, F f) {
  const int64_t count = l.size[3], so = l.out.stride[3], sa = l.in[0].stride[3];
  rows<2>(l, base, {sizeof(O), sizeof(A)}, {&l.out, &l.in[0]}, [&](char** at) {
    O* o = reinterpret_cast<O*>(at[0]);
    const A* a = reinterpret_cast<const A*>(at[1]);
    if (so == 1 && sa == 1)
      for (int64_t k = 0; k < count; k++) o[k] = f(a[k]);
    else
      for (int64_t k = 0; k < count; k++) o[k * so] = f(a[k * sa]);
  });
}

template <class O, class A, class F>
void binary(const Loop& l, char** base, F f) {
  const int64_t count = l.size[3], so = l.out.stride[3], sa = l.in[0].stride[3], sb = l.in[1].stride[3];
  rows<3>(l, base, {sizeof(O), sizeof(A), sizeof(A)}, {&l.out, &l.in[0], &l.in[1]}, [&](char** at) {
    O* o = reinterpret_cast<O*>(at[0]);
    const A *a = reinterpret_cast<const A*>(at[1]), *b = reinterpret_cast<const A*>(at[2]);
    if (so == 1 && sa == 1 && sb == 1)
      for (int64_t k = 0; k < count; k++) o[k] = f(a[k], b[k]);
    else if (so == 1 && sa == 1 && sb == 0)
      for (int64_t k = 0; k < count; k++) o[k] = f(a[k], *b);
    else if (so == 1 && sa == 0 && sb == 1)
      for (int64_t k = 0; k < count; k++) o[k] = f(*a, b[k]);
    else
      for (int64_t k = 0; k < count; k++) o[k * so] = f(a[k * sa], b[k * sb]);
  });
}

template <class T>
void choose(const Loop& l, char** base) {
  const int64_t count = l.size[3], so = l.out.stride[3], sc = l.in[0].stride[3];
  const int64_t sa = l.in[1].stride[3], sb = l.in[2].stride[3];
  rows<4>(l, base, {sizeof(T), 1, sizeof(T), sizeof(T)}, {&l.out, &l.in[0], &l.in[1], &l.in[2]}, [&](char** at) {
    T* o = reinterpret_cast<T*>(at[0]);
    const char* c = at[1];
    const T *a = reinterpret_cast<const T*>(at[2]), *b = reinterpret_cast<const T*>(at[3]);
    for (int64_t k = 0; k < count; k++) o[k * so] = c[k * sc] ? a[k * sa] : b[k * sb];
  });
}

// Sums of the first one, two, three... along the last dimension.
template <class T>
void sums(const Loop& l, char** base) {
  const int64_t count = l.size[3], so = l.out.stride[3], sa = l.in[0].stride[3];
  rows<2>(l, base, {sizeof(T), sizeof(T)}, {&l.out, &l.in[0]}, [&](char** at) {
    T* o = reinterpret_cast<T*>(at[0]);
    const T* a = reinterpret_cast<const T*>(at[1]);
    double sum = 0;
    for (int64_t k = 0; k < count; k++) o[k * so] = static_cast<T>(sum += a[k * sa]);
  });
}

// Rows are along the third dimension; numbers along the last go with them.
template <class T>
void gather(const Loop& l, char** base) {
  const Place &p = l.out, &q = l.in[0];
  char *o = base[p.buffer] + p.offset, *a = base[q.buffer] + q.offset;
  const int64_t count = l.size[3], so = p.stride[3], sa = q.stride[3];
  for (int64_t i = 0; i < l.size[0]; i++)
    for (int64_t j = 0; j < l.size[1]; j++)
      for (int64_t k = 0; k < l.size[2]; k++) {
        T* to = reinterpret_cast<T*>(o) + i * p.stride[0] + j * p.stride[1] + k * p.stride[2];
        const T* from = reinterpret_cast<const T*>(a) + i * q.stride[0] + j * q.stride[1] + l.rows[k] * q.stride[2];
        if (so == 1 && sa == 1)
          std::memcpy(to, from, count * sizeof(T));
        else
          for (int64_t n = 0; n < count; n++) to[n * so] = from[n * sa];
      }
}

template <class T>
bool is_nan(T x) {
  return x != x;
}

template <class T>
void numbers(const Loop& l, char** base) {
  const T alpha = static_cast<T>(l.number);
  switch (l.what) {
    case What::add:
      if (alpha == 1) return binary<T, T>(l, base, [](T a, T b) { return a + b; });
      return binary<T, T>(l, base, [=](T a, T b) { return a + alpha * b; });
    case What::sub:
      if (alpha == 1) return binary<T, T>(l, base, [](T a, T b) { return a - b; });
      return binary<T, T>(l, base, [=](T a, T b) { return a - alpha * b; });
    case What::mul: return binary<T, T>(l, base, [](T a, T b) { return a * b; });
    case What::div: return binary<T, T>(l, base, [](T a, T b) { return a / b; });
    case What::minimum: return binary<T, T>(l, base, [](T a, T b) { return is_nan(a) || a < b ? a : b; });
    case What::maximum: return binary<T, T>(l, base, [](T a, T b) { return is_nan(a) || a > b ? a : b; });
    case What::clamp_min: return binary<T, T>(l, base, [](T a, T b) { return a < b || is_nan(b) ? b : a; });
    case What::clamp_max: return binary<T, T>(l, base, [](T a, T b) { return a > b || is_nan(b) ? b : a; });
    case What::atan2: return binary<T, T>(l, base, [](T a, T b) { return std::atan2(a, b); });
    case What::pow: return binary<T, T>(l, base, [](T a, T b) { return std::pow(a, b); });
    case What::lerp:
      return binary<T, T>(l, base, [=](T a, T b) {
        return std::fabs(alpha) < T(0.5) ? a + alpha * (b - a) : b - (b - a) * (1 - alpha);
      });
    case What::neg: return unary<T, T>(l, base, [](T a) { return -a; });
    case What::abs: return unary<T, T>(l, base, [](T a) { return std::fabs(a); });
    case What::sqrt: return unary<T, T>(l, base, [](T a) { return std::sqrt(a); });
    case What::square: return unary<T, T>(l, base, [](T a) { return a * a; });
    case What::reciprocal: return unary<T, T>(l, base, [](T a) { return T(1) / a; });
    case What::round: return unary<T, T>(l, base, [](T a) { return std::nearbyint(a); });
    case What::floor: return unary<T, T>(l, base, [](T a) { return std::floor(a); });
    case What::sign: return unary<T, T>(l, base, [](T a) { return T(a > 0) - T(a < 0); });
    case What::exp: return unary<T, T>(l, base, [](T a) { return std::exp(a); });
    case What::log: return unary<T, T>(l, base, [](T a) { return std::log(a); });
    case What::sin: return unary<T, T>(l, base, [](T a) { return std::sin(a); });
    case What::cos: return unary<T, T>(l, base, [](T a) { return std::cos(a); });
    case What::tanh: return unary<T, T>(l, base, [](T a) { return std::tanh(a); });
    case What::asin: return unary<T, T>(l, base, [](T a) { return std::asin(a); });
    case What::expm1: return unary<T, T>(l, base, [](T a) { return std::expm1(a); });
    case What::eq: return binary<bool, T>(l, base, [](T a, T b) { return a == b; });
    case What::ne: return binary<bool, T>(l, base, [](T a, T b) { return a != b; });
    case What::lt: return binary<bool, T>(l, base, [](T a, T b) { return a < b; });
    case What::le: return binary<bool, T>(l, base, [](T a, T b) { return a <= b; });
    case What::gt: return binary<bool, T>(l, base, [](T a, T b) { return a > b; });
    case What::ge: return binary<bool, T>(l, base, [](T a, T b) { return a >= b; });
    case What::from_bool: return unary<T, bool>(l, base, [](bool a) { return T(a); });
    case What::cumsum: return sums<T>(l, base);
    default: return;
  }
}

void truths(const Loop& l, char** base) {
  switch (l.what) {
    case What::logical_and: return binary<bool, bool>(l, base, [](bool a, bool b) { return a && b; });
    case What::logical_or: return binary<bool, bool>(l, base, [](bool a, bool b) { return a || b; });
    case What::logical_xor: return binary<bool, bool>(l, base, [](bool a, bool b) { return a != b; });
    case What::logical_not: return unary<bool, bool>(l, base, [](bool a) { return !a; });
    default: return;
  }
}

// What only moves numbers asks for their size alone.
template <class T>
bool moved(const Loop& l, char** base) {
  switch (l.what) {
    case What::copy: unary<T, T>(l, base, [](T a) { return a; }); return true;
    case What::where: choose<T>(l, base); return true;
    case What::gather: gather<T>(l, base); return true;
    default: return false;
  }
}

}  // namespace

extern "C" const char* const* loop_names() { return NAMES; }

extern "C" void run_loops(const Loop* loops, int64_t count, char** base, int threads) {
  char* given[64];
  for (int64_t k = 0; k < count; k++) {
    const Loop& l = loops[k];
    if (l.what == What::kernel) {
      for (int64_t n = 0; n < l.count; n++) given[n] = base[l.given[n].buffer] + l.given[n].offset;
      l.run(given, base[l.out.buffer] + l.out.offset, l.call, threads);
    } else if (l.kind == 0) {
      if (!moved<bool>(l, base)) truths(l, base);
    } else if (l.kind == 1) {
      if (!moved<float>(l, base)) numbers<float>(l, base);
    } else {
      if (!moved<double>(l, base)) numbers<double>(l, base);
    }
  }
}
