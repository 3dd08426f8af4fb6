// Projected Jacobi sweeps between rigid bodies and nodes of a grid, and their derivative; formulas as in
// body_coupling_effect.py.
//
// Nodes by scene: vel (B, R, 3), mass (B, R), chosen (B, R), origin (B, 3), answer (B). Bodies with the scenes last: one
// array (K, B) for each field of Solid. Several scenes are worked on side by side; nodes that no body reaches in any of
// them cost next to nothing.
#include "edge_points.h"
#include "flush.h"

#include <limits>

struct Sizes {
  int64_t scenes, bodies, room, sweeps, corners;  // corners: numbers per grid of a mesh
  const int64_t *size, *shape, *cells;            // nodes along each axis; per body; three per body
  const void* grids;
  double first[3], spacing, reach, recovery, ramp;  // place of the first node of the whole grid; lengths in spacings
};

template <typename T, int N>
struct Solid {
  typedef Three<T, N> V;
  V pos, axes[3];
  Num<T, N> offset, numbers[4];
  V vel, omega;
  Num<T, N> light;
  V agile;
  Num<T, N> mu_s, mu_k;

  V local(const V& a) const { return {dot(axes[0], a), dot(axes[1], a), dot(axes[2], a)}; }
  V world(const V& a) const { return axes[0] * a.x + axes[1] * a.y + axes[2] * a.z; }
  V turned(const V& torque) const {
    const V t = local(torque);
    return world({agile.x * t.x, agile.y * t.y, agile.z * t.z});
  }
  // The greatest of three numbers, 1e-38 or so at least; equal ones share the derivative.
  Num<T, N> most_agile() const {
    typedef Num<T, N> S;
    const S zero(T(0)), one(T(1)), least(std::numeric_limits<T>::min());
    Lanes<T> high = agile.x.x;
    for (int k = 1; k < 3; ++k) high = agile[k].x > high ? agile[k].x : high;
    S sum = zero, many = zero;
    for (int k = 0; k < 3; ++k) {
      const auto here = agile[k].x == high;
      sum = sum + select(here, agile[k], zero), many = many + select(here, one, zero);
    }
    return select(high < least.x, least, sum / many);
  }
};

template <typename T, int N>
struct Node {
  Three<T, N> vel;
  Num<T, N> mass;
};

template <typename T, int N>
static inline Three<T, N> nothing() {
  const Num<T, N> none(T(0));
  return {none, none, none};
}

template <typename T>
struct Block {
  typedef Lanes<T> L;
  struct Pair {
    int body, node;
  };
  Sizes n;
  int64_t b, count;  // first scene, and how many
  List<Pair> pairs;  // that can exchange momentum in some scene, body by body
  List<L> places[3];
  List<Node<T, 0>> nodes;
  List<Solid<T, 0>> solids;
  L answer;

  template <int N>
  struct Met {
    Three<T, N> arm, normal;
    Num<T, N> share, leaving, along, across;
  };
  template <int N>
  struct Found {
    List<Three<T, N>> given, force, torque;  // to nodes and bodies
  };

  L each(const T* from, int64_t step) const {
    L x = L{} + *from;  // lanes behind the end do what the first does
    for (int64_t i = 1; i < count; ++i) x[i] = from[i * step];
    return x;
  }

  Block(const Sizes& n, int64_t b, const T* vel, const T* mass, const T* answer, const T* origin, const int64_t* chosen,
        const T* const* bodies)
      : n(n), b(b), count(n.scenes - b < WIDTH<T> ? n.scenes - b : WIDTH<T>), nodes(n.room), solids(n.bodies) {
    fetch(solids, bodies, b, n.scenes);
    this->answer = each(answer + b, 1);
    for (auto& list : places) list.resize(n.room);
    for (int64_t r = 0; r < n.room; ++r) {
      Node<T, 0>& node = nodes[r];
      node.mass = each(mass + b * n.room + r, n.room);
      for (int a = 0; a < 3; ++a) (&node.vel.x)[a] = each(vel + 3 * (b * n.room + r) + a, 3 * n.room);
      for (int64_t i = 0; i < WIDTH<T>; ++i) {
        const int64_t s = b + (i < count ? i : 0), at = chosen[s * n.room + r];
        const int64_t number[3] = {at / n.size[2] / n.size[1], at / n.size[2] % n.size[1], at % n.size[2]};
        for (int a = 0; a < 3; ++a)
          places[a][r][i] = (origin[3 * s + a] + T(number[a])) * T(n.spacing) + T(n.first[a]);
      }
    }
    for (int k = 0; k < n.bodies; ++k)
      for (int r = 0; r < n.room; ++r) {
        if (!any(nodes[r].mass.x > T(0))) continue;
        if (any(~(meet<0>(solids[k], nodes[r], {k, r}).share.x == T(0)))) pairs.push_back({k, r});
      }
  }

  template <int N>
  Met<N> meet(const Solid<T, N>& body, const Node<T, N>& node, const Pair& p) const {
    typedef Num<T, N> S;
    const S zero(T(0)), one(T(1));
    const Three<T, N> place = {S(places[0][p.node]), S(places[1][p.node]), S(places[2][p.node])};
    Met<N> m;
    m.arm = place - body.pos;
    const Three<T, N> at = body.local(m.arm);
    const S local[3] = {at.x + body.offset, at.y, at.z};
    S normal[3];
    const Grid<T> grid = {(const T*)n.grids + p.body * n.corners, n.cells + 3 * p.body};
    const S distance = probe(int(n.shape[p.body]), grid, body.numbers, local, normal);
    m.normal = body.world({normal[0], normal[1], normal[2]});
    const S felt = (S(T(n.reach)) - distance * S(T(1 / n.spacing))) * S(T(1 / n.ramp));
    m.share = select(node.mass.x > T(0), select(felt.x > T(1), one, positive(felt)), zero);
    m.leaving = S(T(n.recovery)) * positive(-distance - S(T(n.spacing)));
    return m;
  }

  // What bodies and nodes give each other.
  template <int N>
  Found<N> exchange(const List<Solid<T, N>>& solids, const List<Node<T, N>>& nodes, const Num<T, N>& answer) const {
    typedef Num<T, N> S;
    typedef Three<T, N> V;
    const S zero(T(0)), one(T(1));
    const size_t many = pairs.size();
    List<Met<N>> met(many);
    List<S> shares(nodes.size(), zero), weights(solids.size(), zero), turning(solids.size(), zero), sliding = turning;
    for (size_t p = 0; p < many; ++p) {
      const int k = pairs[p].body, r = pairs[p].node;
      Met<N>& m = met[p];
      m = meet<N>(solids[k], nodes[r], pairs[p]);
      const V a = cross(m.arm, m.normal);
      const S square = dot(a, solids[k].turned(a)), weight = m.share * nodes[r].mass;
      const auto turns = square.x > T(0);
      m.along = select(turns, root(select(turns, square, one)), zero);
      V direction;
      m.across = root(solids[k].most_agile()) * measured(m.arm, direction);
      shares[r] = shares[r] + m.share, weights[k] = weights[k] + weight;
      turning[k] = turning[k] + weight * m.along, sliding[k] = sliding[k] + weight * m.across;
    }
    for (size_t p = 0; p < many; ++p) {
      const int k = pairs[p].body, r = pairs[p].node;
      Met<N>& m = met[p];
      const auto there = m.share.x > T(0);
      const S base = answer * shares[r] + solids[k].light * weights[k];
      m.along = select(there, m.share / select(there, base + m.along * turning[k], one), zero);
      m.across = select(there, m.share / select(there, base + m.across * sliding[k], one), zero);
    }
    List<S> normal(many, zero), wanted(many);
    List<V> rubbed(many, nothing<T, N>()), u = rubbed;
    Found<N> f;
    sum(met, nodes, u, f);
    for (int64_t sweep = 0; sweep < n.sweeps; ++sweep) {
      for (size_t p = 0; p < many; ++p) {
        const int k = pairs[p].body, r = pairs[p].node;
        const Met<N>& m = met[p];
        const Solid<T, N>& body = solids[k];
        const V there = nodes[r].vel + f.given[r] * answer, moved = body.vel + f.force[k] * body.light;
        const V apart = there - moved - cross(body.omega + body.turned(f.torque[k]), m.arm);
        const S parting = dot(apart, m.normal);
        if (sweep == 0) wanted[p] = (one - m.share) * select(parting.x > T(0), zero, parting) + m.leaving;
        normal[p] = positive(normal[p] + m.along * (wanted[p] - parting));
        const V trial = rubbed[p] - (apart - m.normal * parting) * m.across;
        V direction;
        const S size = measured(trial, direction);
        const auto sticks = (normal[p].x > T(0)) & (size.x <= (body.mu_s * normal[p]).x);
        const auto some = size.x > T(0);
        const V sliding = trial * (body.mu_k * normal[p] / select(some, size, one));
        rubbed[p] = {select(sticks, trial.x, sliding.x), select(sticks, trial.y, sliding.y),
                     select(sticks, trial.z, sliding.z)};
        u[p] = m.normal * normal[p] + rubbed[p];
      }
      sum(met, nodes, u, f);
    }
    for (V& x : f.given) x = x * answer;
    return f;
  }
  template <int N>
  void sum(const List<Met<N>>& met, const List<Node<T, N>>& nodes, const List<Three<T, N>>& u, Found<N>& f) const {
    f.given.assign(n.room, nothing<T, N>());
    f.force.assign(n.bodies, nothing<T, N>()), f.torque = f.force;
    for (size_t p = 0; p < pairs.size(); ++p) {
      const int k = pairs[p].body, r = pairs[p].node;
      const Three<T, N> impulse = u[p] * (-nodes[r].mass);
      f.given[r] += u[p];
      f.force[k] += impulse, f.torque[k] += cross(met[p].arm, impulse);
    }
  }

  void spread(const L& x, T* to, int64_t step) const {
    for (int64_t i = 0; i < count; ++i) to[i * step] = x[i];
  }
};

#define BLOCKS _Pragma("omp parallel for num_threads(threads)") \
  for (int64_t b = 0; b < n.scenes; b += WIDTH<T>) if (const FlushTiny flush; true)

template <typename T>
static void exchange(const T* vel, const T* mass, const T* answer, const T* origin, const int64_t* chosen,
                     const T* const* bodies, T* given, T* const* wrench, const Sizes& n, int threads) {
  BLOCKS {
    const Block<T> block(n, b, vel, mass, answer, origin, chosen, bodies);
    const auto found = block.template exchange<0>(block.solids, block.nodes, Num<T, 0>(block.answer));
    for (int64_t r = 0; r < n.room; ++r)
      for (int a = 0; a < 3; ++a) block.spread(found.given[r][a].x, given + 3 * (b * n.room + r) + a, 3 * n.room);
    for (int64_t k = 0; k < n.bodies; ++k)
      for (int a = 0; a < 3; ++a) {
        store<T>(wrench[a] + k * n.scenes + b, found.force[k][a].x, n.scenes - b);
        store<T>(wrench[3 + a] + k * n.scenes + b, found.torque[k][a].x, n.scenes - b);
      }
  }
}

template <typename T>
static void back(const T* vel, const T* mass, const T* answer, const T* origin, const int64_t* chosen,
                 const T* const* bodies, const T* given_by, const T* const* wrench_by, T* dvel, T* dmass, T* danswer,
                 T* const* dbodies, const Sizes& n, int threads) {
  typedef Num<T, TAPED> R;
  typedef Lanes<T> L;
  constexpr int FIELDS = sizeof(Solid<T, 0>) / sizeof(L);
  BLOCKS {
    const Block<T> block(n, b, vel, mass, answer, origin, chosen, bodies);
    Tape<T>& tape = Tape<T>::on();
    tape.nodes.clear();
    List<Solid<T, TAPED>> solids(n.bodies);
    List<Node<T, TAPED>> nodes(n.room);
    std::vector<char> met(n.room);
    const R share = R::variable(block.answer, 0);
    for (const auto& p : block.pairs) met[p.node] = 1;
    for (int64_t k = 0; k < n.bodies; ++k)
      for (int i = 0; i < FIELDS; ++i) ((R*)&solids[k])[i] = R::variable(((const L*)&block.solids[k])[i], 0);
    for (int64_t r = 0; r < n.room; ++r)
      for (int i = 0; i < 4; ++i) {
        const L x = ((const L*)&block.nodes[r])[i];
        ((R*)&nodes[r])[i] = met[r] ? R::variable(x, 0) : R(x);
      }
    const auto found = block.template exchange<TAPED>(solids, nodes, share);
    tape.begin();
    for (int64_t r = 0; r < n.room; ++r)
      for (int a = 0; a < 3; ++a)
        if (met[r]) found.given[r][a].give(block.each(given_by + 3 * (b * n.room + r) + a, 3 * n.room));
    for (int64_t k = 0; k < n.bodies; ++k)
      for (int a = 0; a < 3; ++a) {
        found.force[k][a].give(load(wrench_by[a] + k * n.scenes + b, n.scenes - b));
        found.torque[k][a].give(load(wrench_by[3 + a] + k * n.scenes + b, n.scenes - b));
      }
    tape.back(int(tape.nodes.size()), 0);
    block.spread(share.by(), danswer + b, 1);
    for (int64_t r = 0; r < n.room; ++r) {
      for (int a = 0; a < 3; ++a) block.spread(nodes[r].vel[a].by(), dvel + 3 * (b * n.room + r) + a, 3 * n.room);
      block.spread(nodes[r].mass.by(), dmass + b * n.room + r, n.room);
    }
    for (int64_t k = 0; k < n.bodies; ++k)
      for (int i = 0; i < FIELDS; ++i)
        store<T>(dbodies[i] + k * n.scenes + b, ((const R*)&solids[k])[i].by(), n.scenes - b);
    tape.rest();
  }
}

#define ENTRY(T)                                                                                                     \
  extern "C" void body_nodes_##T##_exchange(const T* vel, const T* mass, const T* answer, const T* origin,           \
                                            const int64_t* chosen, const T* const* bodies, T* given,                 \
                                            T* const* wrench, const Sizes* n, int threads) {                         \
    exchange<T>(vel, mass, answer, origin, chosen, bodies, given, wrench, *n, threads);                              \
  }                                                                                                                  \
  extern "C" void body_nodes_##T##_back(const T* vel, const T* mass, const T* answer, const T* origin,               \
                                        const int64_t* chosen, const T* const* bodies, const T* given_by,            \
                                        const T* const* wrench_by, T* dvel, T* dmass, T* danswer,                    \
                                        T* const* dbodies, const Sizes* n, int threads) {                            \
    back<T>(vel, mass, answer, origin, chosen, bodies, given_by, wrench_by, dvel, dmass, danswer, dbodies, *n,       \
            threads);                                                                                                \
  }
ENTRY(float)
ENTRY(double)
