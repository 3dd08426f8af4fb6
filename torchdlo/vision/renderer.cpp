// Pictures of scenes: triangles into a z-buffer, shaded once per surface in a pixel, with a shadow map.
//
// Per scene: pieces are placed, tubes are put round ropes, and all that casts shadows is drawn once as the key light sees
// it. Per camera: triangles leave depth and number in a buffer with 1 or 4 samples per pixel; then each pixel shades the
// surfaces that its samples see. No function of the C library beside square roots is used, so that bytes do not depend on
// it. The same in array operations: renderer_reference.py.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

namespace {

struct Call {
    int64_t batch, cameras, width, height, samples;
    int64_t vertices, faces, pieces, ropes, slots, particles, groups, shadow, detail;
    // Rigid pieces.
    const float *vertex, *normal;
    const int32_t *face, *piece_vertex, *piece_face, *piece_flags;
    const int16_t* piece_id;
    const float *piece_sphere, *piece_pose, *piece_material;
    // Ropes.
    const int32_t *rope_start, *rope_closed;
    const int16_t* rope_id;
    const float *rope_pos, *rope_radius, *rope_material;
    // Particles.
    const float *particle_pos, *particle_radius;
    const int32_t* particle_group;
    const int16_t* group_id;
    const float* group_material;
    const float *camera, *light;
    uint8_t* rgb;
    float* depth;
    int16_t* ids;
};

constexpr int POSE = 12, MATERIAL = 12, CAMERA = 16, LIGHT = 32;
constexpr float NEAR = 0.01f, FAR = -1e30f;
constexpr uint32_t NONE = 0xffffffffu;
enum { CASTS = 1, TWO_SIDED = 2 };

struct Vec {
    float x, y, z;
};
inline Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec operator-(Vec a, Vec b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec operator*(float s, Vec a) { return {s * a.x, s * a.y, s * a.z}; }
inline Vec operator*(Vec a, Vec b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
inline float dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec cross(Vec a, Vec b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
inline Vec unit(Vec a) {
    float s = dot(a, a);
    return s > 1e-30f ? (1.0f / std::sqrt(s)) * a : Vec{0, 0, 1};
}
inline Vec load(const float* p) { return {p[0], p[1], p[2]}; }
inline float clamp01(float x) { return std::min(1.0f, std::max(0.0f, x)); }
inline Vec mix(Vec a, Vec b, float s) { return a + s * (b - a); }
inline float smooth(float x) {
    x = clamp01(x);
    return x * x * (3 - 2 * x);
}
inline Vec turn(const float* m, Vec p) {  // rows of a 3 x 3 matrix
    return {m[0] * p.x + m[1] * p.y + m[2] * p.z, m[3] * p.x + m[4] * p.y + m[5] * p.z,
            m[6] * p.x + m[7] * p.y + m[8] * p.z};
}

// What is drawn, in the world.
struct Mesh {
    std::vector<Vec> pos, normal;
    std::vector<float> uv;          // two per vertex of a rope
    std::vector<int32_t> face;      // three per triangle
    std::vector<int32_t> owner;     // per triangle: piece, or pieces + rope
    int64_t fixed = 0, rope_vertex = 0;
};

struct Span {
    int32_t first_vertex, last_vertex, first_face, last_face;
    Vec middle;
    float reach;
    int flags;
};

// Sines of multiples of a turn by 1 / n, without the C library.
void ring(int n, std::vector<float>& c, std::vector<float>& s) {
    c.resize(n + 1), s.resize(n + 1);
    for (int k = 0; k <= n; ++k) {
        // Within an eighth of a turn the series is exact to single precision.
        double t = double(k) / n * 8;
        int part = int(t);
        double x = (t - part) * 0.78539816339744831, y = 0.78539816339744831 - x;
        bool odd = part & 1;
        double a = odd ? y : x, q = a * a;
        double sine = a * (1 - q / 6 * (1 - q / 20 * (1 - q / 42 * (1 - q / 72))));
        double cosine = 1 - q / 2 * (1 - q / 12 * (1 - q / 30 * (1 - q / 56)));
        double fc, fs;
        switch (part & 7) {
            case 0: fc = cosine, fs = sine; break;
            case 1: fc = sine, fs = cosine; break;
            case 2: fc = -sine, fs = cosine; break;
            case 3: fc = -cosine, fs = sine; break;
            case 4: fc = -cosine, fs = -sine; break;
            case 5: fc = -sine, fs = -cosine; break;
            case 6: fc = sine, fs = -cosine; break;
            default: fc = cosine, fs = -sine; break;
        }
        c[k] = float(fc), s[k] = float(fs);
    }
}

// Add the tube of a rope: rings about a smooth curve through its vertices, with round ends.
void tube(const Call& call, const float* all, int64_t rope, int sides, int parts, Mesh& out) {
    const int first = call.rope_start[rope], count = call.rope_start[rope + 1] - first;
    const bool closed = call.rope_closed[rope];
    if (count < 2) return;
    auto at = [&](int k) {
        if (closed) return load(all + 3 * (first + (k % count + count) % count));
        if (k < 0) return 2.0f * load(all + 3 * first) - load(all + 3 * (first + 1));
        if (k >= count) return 2.0f * load(all + 3 * (first + count - 1)) - load(all + 3 * (first + count - 2));
        return load(all + 3 * (first + k));
    };
    auto wide = [&](int k) { return call.rope_radius[first + (closed ? k % count : std::min(k, count - 1))]; };
    std::vector<Vec> x;
    std::vector<float> r;
    const int edges = closed ? count : count - 1;
    for (int e = 0; e < edges; ++e) {
        Vec a = at(e - 1), b = at(e), c = at(e + 1), d = at(e + 2);
        for (int k = 0; k < parts; ++k) {
            float t = float(k) / parts, t2 = t * t, t3 = t2 * t;  // Catmull and Rom 1974
            x.push_back(0.5f * ((2.0f * b) + t * (c - a) + t2 * (2.0f * a - 5.0f * b + 4.0f * c - d) +
                                t3 * (3.0f * b - a - 3.0f * c + d)));
            r.push_back(wide(e) + t * (wide(e + 1) - wide(e)));
        }
    }
    x.push_back(at(edges)), r.push_back(wide(edges));
    const int n = int(x.size());
    std::vector<Vec> tangent(n), across(n);
    for (int k = 0; k < n; ++k) {
        Vec before = k > 0 ? x[k - 1] : closed ? x[n - 2] : x[0], after = k + 1 < n ? x[k + 1] : closed ? x[1] : x[n - 1];
        tangent[k] = unit(after - before);
    }
    Vec t = tangent[0];
    Vec other = std::fabs(t.x) < 0.6f ? Vec{1, 0, 0} : Vec{0, 1, 0};
    Vec v = unit(other - dot(other, t) * t);
    for (int k = 0; k < n; ++k) across[k] = v = unit(v - dot(v, tangent[k]) * tangent[k]);
    std::vector<float> cosine, sine;
    ring(sides, cosine, sine);
    int32_t before = -1;
    float along = 0;
    const int32_t owner = int32_t(call.pieces + rope);
    auto add = [&](Vec middle, Vec ahead, Vec side, float radius, float slope) {
        const int32_t start = int32_t(out.pos.size());
        Vec third = cross(ahead, side);
        for (int k = 0; k <= sides; ++k) {
            Vec away = cosine[k] * side + sine[k] * third;
            out.pos.push_back(middle + radius * away);
            out.normal.push_back(unit(away + slope * ahead));
            out.uv.push_back(float(k) / sides), out.uv.push_back(along);
        }
        if (before >= 0)
            for (int k = 0; k < sides; ++k) {
                int32_t p = before + k, q = start + k;
                for (int32_t corner : {p, p + 1, q, p + 1, q + 1, q}) out.face.push_back(corner);
                out.owner.push_back(owner), out.owner.push_back(owner);
            }
        before = start;
    };
    // Half balls: rings at sines of 90, 60 and 30 degrees.
    const float height[3] = {0.9999f, 0.8660254f, 0.5f}, width[3] = {0.0141f, 0.5f, 0.8660254f};
    if (!closed)
        for (int k = 0; k < 3; ++k) add(x[0] - height[k] * r[0] * tangent[0], tangent[0], across[0], width[k] * r[0], -height[k] / width[k]);
    for (int k = 0; k < n; ++k) {
        if (k > 0) {
            Vec step = x[k] - x[k - 1];
            along += std::sqrt(dot(step, step));
        }
        add(x[k], tangent[k], across[k], r[k], 0);
    }
    if (!closed)
        for (int k = 2; k >= 0; --k)
            add(x[n - 1] + height[k] * r[n - 1] * tangent[n - 1], tangent[n - 1], across[n - 1], width[k] * r[n - 1],
                height[k] / width[k]);
}

// Put all rigid pieces where they are.
void place(const Call& call, int64_t b, Mesh& out, std::vector<Span>& spans) {
    out.pos.resize(call.vertices), out.normal.resize(call.vertices);
    out.face.assign(call.face, call.face + 3 * call.faces);
    out.owner.resize(call.faces), out.uv.clear();
    spans.clear();
    for (int64_t p = 0; p < call.pieces; ++p) {
        const float* pose = call.piece_pose + POSE * (b * call.pieces + p);
        const Vec shift = load(pose + 9);
        for (int32_t k = call.piece_vertex[p]; k < call.piece_vertex[p + 1]; ++k) {
            out.pos[k] = turn(pose, load(call.vertex + 3 * k)) + shift;
            out.normal[k] = turn(pose, load(call.normal + 3 * k));
        }
        for (int32_t k = call.piece_face[p]; k < call.piece_face[p + 1]; ++k) out.owner[k] = int32_t(p);
        const float* ball = call.piece_sphere + 4 * p;
        spans.push_back({call.piece_vertex[p], call.piece_vertex[p + 1], call.piece_face[p], call.piece_face[p + 1],
                         turn(pose, load(ball)) + shift, ball[3], call.piece_flags[p]});
    }
    out.fixed = call.faces, out.rope_vertex = call.vertices;
}

// Add the tubes of all ropes, with a detail that suits `focal / depth` pixels per metre (0: the most).
void place_ropes(const Call& call, int64_t b, float pixels, Mesh& out, std::vector<Span>& spans) {
    out.pos.resize(call.vertices), out.normal.resize(call.vertices);
    out.face.resize(3 * call.faces), out.owner.resize(call.faces), out.uv.clear();
    spans.resize(call.pieces);
    const float* all = call.rope_pos + 3 * call.slots * b;
    for (int64_t rope = 0; rope < call.ropes; ++rope) {
        const int first = call.rope_start[rope], last = call.rope_start[rope + 1];
        Vec low = load(all + 3 * first), high = low;
        float radius = 0, length = 0;
        for (int k = first; k < last; ++k) {
            Vec p = load(all + 3 * k);
            low = {std::min(low.x, p.x), std::min(low.y, p.y), std::min(low.z, p.z)};
            high = {std::max(high.x, p.x), std::max(high.y, p.y), std::max(high.z, p.z)};
            radius = std::max(radius, call.rope_radius[k]);
            if (k > first) {
                Vec step = p - load(all + 3 * (k - 1));
                length = std::max(length, std::sqrt(dot(step, step)));
            }
        }
        int sides = 16, parts = 3;
        if (pixels > 0) {
            float thick = radius * pixels, edge = length * pixels;
            sides = thick < 2 ? 6 : thick < 5 ? 8 : thick < 14 ? 12 : 16;
            parts = edge < 4 ? 1 : edge < 12 ? 2 : edge < 40 ? 3 : 4;
        }
        Span span{int32_t(out.pos.size()), 0, int32_t(out.owner.size()), 0, 0.5f * (low + high), 0, CASTS};
        Vec wide = 0.5f * (high - low);
        span.reach = std::sqrt(dot(wide, wide)) + 2 * radius + 0.3f * length;
        tube(call, all, rope, sides, parts, out);
        span.last_vertex = int32_t(out.pos.size()), span.last_face = int32_t(out.owner.size());
        spans.push_back(span);
    }
}

// A picture of numbers of triangles, nearest first. Depths are kept as 1 / z.
struct Buffer {
    int width = 0, height = 0;
    std::vector<float> near;
    std::vector<uint32_t> number;
    void clear(int w, int h) {
        width = w, height = h;
        near.assign(size_t(w) * h, 0.0f);
        number.assign(size_t(w) * h, NONE);
    }
};

struct Corner {
    float x, y, w;  // place in the buffer, and what is interpolated
};

// Draw a triangle whose `w` is linear in the buffer; larger is nearer.
template <bool NUMBERED>
inline void draw(const Corner& a, const Corner& b, const Corner& c, uint32_t number, bool both, int width, int height,
                 float* near, uint32_t* numbers) {
    float area = (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x);
    // y goes down: outward faces turn the other way.
    if (!(both ? area != 0 : area < 0)) return;
    float low_x = std::min(a.x, std::min(b.x, c.x)), high_x = std::max(a.x, std::max(b.x, c.x));
    float low_y = std::min(a.y, std::min(b.y, c.y)), high_y = std::max(a.y, std::max(b.y, c.y));
    if (!(high_x >= 0 && high_y >= 0 && low_x <= float(width - 1) && low_y <= float(height - 1))) return;
    int x0 = int(std::ceil(std::max(0.0f, low_x))), x1 = int(std::floor(std::min(float(width - 1), high_x)));
    int y0 = int(std::ceil(std::max(0.0f, low_y))), y1 = int(std::floor(std::min(float(height - 1), high_y)));
    if (x0 > x1 || y0 > y1) return;
    // Barycentric coordinates of b and c are linear in x. Triangles may reach far beyond the picture: rows start in double
    // precision.
    const double over = 1.0 / (double(b.x - a.x) * (c.y - a.y) - double(b.y - a.y) * (c.x - a.x));
    const double dux = over * (c.y - a.y), duy = -over * (c.x - a.x), dvx = -over * (b.y - a.y), dvy = over * (b.x - a.x);
    const double wu = double(b.w) - a.w, wv = double(c.w) - a.w;
    const float ux = float(dux), vx = float(dvx), wx = float(wu * dux + wv * dvx);
    constexpr float EDGE = -1e-6f;
    for (int y = y0; y <= y1; ++y) {
        const double dx = double(x0) - a.x, dy = double(y) - a.y, du = duy * dy + dux * dx, dv = dvy * dy + dvx * dx;
        const float u0 = float(du), v0 = float(dv), w0 = float(a.w + wu * du + wv * dv);
        // Where the row is inside: all three of u, v, 1 - u - v are not negative.
        float from = 0, to = float(x1 - x0);
        auto cut = [&](float slope, float start) {
            if (slope > 1e-12f) from = std::max(from, (EDGE - start) / slope - 1);
            else if (slope < -1e-12f) to = std::min(to, (EDGE - start) / slope + 1);
        };
        if (x1 - x0 > 8) {
            cut(ux, u0), cut(vx, v0), cut(-ux - vx, 1 - u0 - v0);
            if (!(from <= to)) continue;
        }
        const int begin = std::max(0, int(from)), end = std::min(x1 - x0, int(to));
        float* line = near + size_t(y) * width + x0;
        uint32_t* row = NUMBERED ? numbers + size_t(y) * width + x0 : nullptr;
#pragma GCC ivdep
        for (int x = begin; x <= end; ++x) {
            float fx = float(x), u = u0 + ux * fx, v = v0 + vx * fx, w = w0 + wx * fx;
            bool hit = (u >= EDGE) & (v >= EDGE) & (1 - u - v >= EDGE) & (w > line[x]);
            line[x] = hit ? w : line[x];
            if (NUMBERED) row[x] = hit ? number : row[x];
        }
    }
}

struct Camera {
    float fx, fy, cx, cy, turn[9];
    Vec shift, eye;
    explicit Camera(const float* p) : fx(p[0]), fy(p[1]), cx(p[2]), cy(p[3]), shift(load(p + 13)) {
        std::memcpy(turn, p + 4, sizeof turn);
        const float* m = turn;
        eye = {-(m[0] * shift.x + m[3] * shift.y + m[6] * shift.z), -(m[1] * shift.x + m[4] * shift.y + m[7] * shift.z),
               -(m[2] * shift.x + m[5] * shift.y + m[8] * shift.z)};
    }
    Vec local(Vec p) const { return ::turn(turn, p) + shift; }
    Vec back(Vec d) const {
        const float* m = turn;
        return {m[0] * d.x + m[3] * d.y + m[6] * d.z, m[1] * d.x + m[4] * d.y + m[7] * d.z,
                m[2] * d.x + m[5] * d.y + m[8] * d.z};
    }
    // Whether a ball can be seen.
    bool sees(Vec middle, float reach, int width, int height) const {
        Vec p = local(middle);
        if (p.z + reach < NEAR) return false;
        auto beyond = [&](float x, float z, float slope) {  // of the plane x = slope z, on the side of larger x
            return x - slope * z > reach * std::sqrt(1 + slope * slope);
        };
        return !(beyond(p.x, p.z, (float(width) - 0.5f - cx) / fx) || beyond(-p.x, p.z, (cx + 0.5f) / fx) ||
                 beyond(p.y, p.z, (float(height) - 0.5f - cy) / fy) || beyond(-p.y, p.z, (cy + 0.5f) / fy));
    }
};

// The scene as the key light sees it: 1 is nearest to the light, 0 as far as anything that casts a shadow, FAR is nothing.
struct Shadow {
    int size = 0;
    Vec right, up, ahead;  // axes; ahead points away from the light
    float x0, y0, z0, scale, deep;
    std::vector<float> near, coarse;  // nearest surface per texel, and the nearest of blocks of texels and their neighbours
    int blocks = 0;
    static constexpr int BLOCK = 12;

    void draw_all(const Call& call, int64_t b, const Mesh& mesh, const std::vector<Span>& spans, Vec to_light) {
        size = int(call.shadow);
        if (!size) return;
        ahead = -1.0f * unit(to_light);
        Vec other = std::fabs(ahead.z) < 0.9f ? Vec{0, 0, 1} : Vec{0, 1, 0};
        right = unit(cross(ahead, other)), up = cross(right, ahead);
        Vec low{1e30f, 1e30f, 1e30f}, high{-1e30f, -1e30f, -1e30f};
        auto hold = [&](Vec p, float r) {
            Vec q{dot(p, right), dot(p, up), dot(p, ahead)};
            low = {std::min(low.x, q.x - r), std::min(low.y, q.y - r), std::min(low.z, q.z - r)};
            high = {std::max(high.x, q.x + r), std::max(high.y, q.y + r), std::max(high.z, q.z + r)};
        };
        for (const Span& s : spans)
            if (s.flags & CASTS)
                for (int32_t k = s.first_vertex; k < s.last_vertex; ++k) hold(mesh.pos[k], 0);
        const float* points = call.particle_pos + 3 * call.particles * b;
        for (int64_t k = 0; k < call.particles; ++k) hold(load(points + 3 * k), call.particle_radius[k]);
        if (!(low.x <= high.x)) {
            size = 0;
            return;
        }
        float wide = 1.04f * std::max(std::max(high.x - low.x, high.y - low.y), 0.8f);
        x0 = 0.5f * (low.x + high.x - wide), y0 = 0.5f * (low.y + high.y - wide), z0 = high.z;
        deep = std::max(high.z - low.z, 1e-3f), scale = float(size) / wide;
        near.assign(size_t(size) * size, FAR);
        std::vector<Corner> at(mesh.pos.size());
        for (const Span& s : spans) {
            if (!(s.flags & CASTS)) continue;
            for (int32_t k = s.first_vertex; k < s.last_vertex; ++k) at[k] = corner(mesh.pos[k]);
            for (int32_t k = s.first_face; k < s.last_face; ++k) {
                const int32_t* f = &mesh.face[3 * k];
                draw<false>(at[f[0]], at[f[1]], at[f[2]], 0, true, size, size, near.data(), nullptr);
            }
        }
        for (int64_t k = 0; k < call.particles; ++k) {
            Corner c = corner(load(points + 3 * k));
            float r = call.particle_radius[k] * scale;
            for (int y = std::max(0, int(c.y - r)); y <= std::min(size - 1, int(c.y + r + 1)); ++y)
                for (int x = std::max(0, int(c.x - r)); x <= std::min(size - 1, int(c.x + r + 1)); ++x) {
                    float d = (x - c.x) * (x - c.x) + (y - c.y) * (y - c.y);
                    float& n = near[size_t(y) * size + x];
                    if (d <= r * r) n = std::max(n, c.w);
                }
        }
        blocks = (size + BLOCK - 1) / BLOCK;
        std::vector<float> own(size_t(blocks) * blocks, FAR);
        for (int y = 0; y < size; ++y)
            for (int x = 0; x < size; ++x) {
                float& c = own[size_t(y / BLOCK) * blocks + x / BLOCK];
                c = std::max(c, near[size_t(y) * size + x]);
            }
        coarse.assign(own.size(), FAR);
        for (int y = 0; y < blocks; ++y)
            for (int x = 0; x < blocks; ++x)
                for (int j = std::max(0, y - 1); j <= std::min(blocks - 1, y + 1); ++j)
                    for (int i = std::max(0, x - 1); i <= std::min(blocks - 1, x + 1); ++i) {
                        float& c = coarse[size_t(y) * blocks + x];
                        c = std::max(c, own[size_t(j) * blocks + i]);
                    }
    }

    Corner corner(Vec p) const {
        return {(dot(p, right) - x0) * scale - 0.5f, (dot(p, up) - y0) * scale - 0.5f, (z0 - dot(p, ahead)) / deep};
    }

    // Share of the key light that arrives at a point [1].
    float lit(Vec p, Vec normal, float facing, float softness) const {
        if (!size) return 1;
        const float texel = 1 / scale;
        Corner c = corner(p + (1.2f + 1.5f * (1 - facing)) * texel * normal);
        const float own = c.w + 1.5f * texel / deep;
        // Neighbouring blocks are looked at, too.
        int bx = int(std::floor(c.x / BLOCK)), by = int(std::floor(c.y / BLOCK));
        if (bx < -1 || by < -1 || bx > blocks || by > blocks) return 1;
        bx = std::min(blocks - 1, std::max(0, bx)), by = std::min(blocks - 1, std::max(0, by));
        if (coarse[size_t(by) * blocks + bx] <= own) return 1;
        static const float AROUND[12][2] = {{-0.33f, -0.41f}, {-0.84f, -0.07f}, {-0.70f, 0.46f}, {-0.20f, 0.62f},
                                            {0.96f, -0.19f},  {0.47f, -0.48f},  {0.52f, 0.77f},  {0.19f, -0.89f},
                                            {0.51f, 0.06f},   {0.90f, 0.41f},   {-0.32f, -0.93f}, {-0.05f, 0.15f}};
        // The penumbra grows with the distance from what casts the shadow.
        const float limit = BLOCK - 2.0f;
        float blocked = 0, total = 0;
        for (const auto& d : AROUND) {
            float n = texel_at(int(c.x + limit * d[0] + 0.5f), int(c.y + limit * d[1] + 0.5f));
            if (n > own) blocked += n - own, total += 1;
        }
        {
            float n = texel_at(int(c.x + 0.5f), int(c.y + 0.5f));
            if (n > own) blocked += n - own, total += 1;
        }
        if (total == 0) return 1;
        float radius = std::min(limit, std::max(0.8f, softness * (blocked / total) * deep * scale));
        float sum = 0;
        for (const auto& d : AROUND) sum += filtered(c.x + radius * d[0], c.y + radius * d[1], own);
        if (radius < 1.5f) return 1 - sum / 12;
        // A wide penumbra needs more places.
        for (const auto& d : AROUND) sum += filtered(c.x - radius * d[1], c.y + radius * d[0], own);
        for (const auto& d : AROUND) sum += filtered(c.x - radius * d[0], c.y - radius * d[1], own);
        return 1 - sum / 36;
    }

  private:
    float texel_at(int x, int y) const {
        return x < 0 || y < 0 || x >= size || y >= size ? FAR : near[size_t(y) * size + x];
    }
    // Share of the four texels about a place that are in front.
    float filtered(float x, float y, float own) const {
        float fx = std::floor(x), fy = std::floor(y), s = x - fx, t = y - fy;
        int i = int(fx), j = int(fy);
        float a = texel_at(i, j) > own, b = texel_at(i + 1, j) > own, c = texel_at(i, j + 1) > own,
              d = texel_at(i + 1, j + 1) > own;
        return (1 - t) * ((1 - s) * a + s * b) + t * ((1 - s) * c + s * d);
    }
};

// Noise without the C library.
inline float hashed(int32_t x, int32_t y, uint32_t seed) {
    uint32_t h = uint32_t(x) * 0x8da6b343u ^ uint32_t(y) * 0xd8163841u ^ seed * 0xcb1ab31fu;
    h ^= h >> 13, h *= 0x5bd1e995u, h ^= h >> 15, h *= 0x27d4eb2du, h ^= h >> 13;
    return float(h >> 8) * (1.0f / 16777216.0f);
}
inline float noise(float x, float y, uint32_t seed) {
    float fx = std::floor(x), fy = std::floor(y);
    int32_t i = int32_t(fx), j = int32_t(fy);
    float s = smooth(x - fx), t = smooth(y - fy);
    float a = hashed(i, j, seed), b = hashed(i + 1, j, seed), c = hashed(i, j + 1, seed), d = hashed(i + 1, j + 1, seed);
    return (1 - t) * ((1 - s) * a + s * b) + t * ((1 - s) * c + s * d);
}
inline float wave(float x) {  // of period 1, between 0 and 1
    float f = x - std::floor(x);
    return smooth(f < 0.5f ? 2 * f : 2 - 2 * f);
}

enum { PLAIN, WOOD, SPECKLED, CHECKED, WOVEN, TWISTED };

struct Light {
    Vec key_to, key, fill_to, fill, sky, ground, wall_top, wall_bottom, floor;
    float floor_height, softness, floor_extent;
    explicit Light(const float* p)
        : key_to(unit(load(p))), key(load(p + 3)), fill_to(unit(load(p + 6))), fill(load(p + 9)), sky(load(p + 12)),
          ground(load(p + 15)), wall_top(load(p + 18)), wall_bottom(load(p + 21)), floor(load(p + 24)),
          floor_height(p[27]), softness(p[28]), floor_extent(p[29]) {}
};

// Colour of a surface before light falls on it. `blur` is the width of a pixel there [m].
Vec painted(const float* m, Vec p, float u, float v, float blur) {
    const Vec one = load(m), two = load(m + 3);
    const int kind = int(m[7]);
    if (kind == PLAIN) return one;
    const float scale = m[8], sharp = clamp01(1.5f - blur * scale);
    const uint32_t seed = uint32_t(m[11]);
    if (kind == TWISTED) {
        float s = wave(u * m[9] + v * scale);
        return mix(mix(one, two, 0.35f), mix(one, two, s), clamp01(1.3f - 0.7f * blur * scale));
    }
    const float x = (m[9] * p.x + m[10] * p.y) * scale, y = (m[9] * p.y - m[10] * p.x) * scale;
    float s = 0.5f;
    if (kind == WOOD) {
        float board = std::floor(y), off = hashed(int32_t(board), 7, seed);
        float grain = noise(0.6f * x + 9 * off, 9 * (y - board) + 37 * off, seed);
        float fine = noise(3 * x + 5 * off, 40 * (y - board), seed + 1);
        s = 0.2f + 0.35f * off + 0.3f * grain + 0.25f * sharp * fine;
        float edge = std::min(y - board, board + 1 - y);
        s += sharp * 0.35f * clamp01(1 - edge / 0.025f);
    } else if (kind == SPECKLED) {
        s = 0.5f * noise(x, y, seed) + 0.3f * noise(3.1f * x, 3.1f * y, seed + 1) +
            0.2f * (sharp * noise(11 * x, 11 * y, seed + 2) + (1 - sharp) * 0.5f);
    } else if (kind == CHECKED) {
        int32_t i = int32_t(std::floor(x)), j = int32_t(std::floor(y));
        s = (1 - sharp) * 0.5f + sharp * float((i + j) & 1);
    } else if (kind == WOVEN) {
        float weave = 0.5f * (wave(x) + wave(y));
        s = 0.5f + sharp * (weave - 0.5f) * 0.7f + 0.4f * (noise(0.13f * x, 0.13f * y, seed) - 0.5f);
    }
    return mix(one, two, clamp01(s));
}

Vec shaded(const Light& light, const Shadow& shadow, Vec p, Vec n, Vec to_eye, Vec color, float gloss) {
    if (dot(n, to_eye) < 0) n = unit(n - 1.02f * dot(n, to_eye) * to_eye);  // interpolated beyond the edge
    const float facing = dot(n, light.key_to);
    const float key = facing > 0 ? facing * shadow.lit(p, n, facing, light.softness) : 0.0f;
    const float fill = std::max(0.0f, 0.75f * dot(n, light.fill_to) + 0.25f);
    Vec sum = color * (key * light.key + fill * light.fill + mix(light.ground, light.sky, 0.5f + 0.5f * n.z));
    if (gloss > 0) {
        Vec half = unit(light.key_to + to_eye);
        float s = std::max(0.0f, dot(n, half));
        for (int k = 0; k < 5; ++k) s *= s;
        float rim = 1 - std::max(0.0f, dot(n, to_eye));
        rim = rim * rim * rim * rim;
        sum = sum + gloss * ((facing > 0 ? key / std::max(facing, 0.2f) : 0.0f) * s * light.key + 0.3f * rim * light.sky);
    }
    return sum;
}

// What is seen where nothing is: the floor of the room, and a wall that goes over into it.
Vec behind(const Light& light, Vec eye, Vec ray) {
    Vec wall = mix(light.wall_bottom, light.wall_top, smooth(0.5f + 1.2f * ray.z));
    if (ray.z >= -1e-4f || eye.z <= light.floor_height) return wall;
    float away = (light.floor_height - eye.z) / ray.z;
    float flat = std::sqrt(ray.x * ray.x + ray.y * ray.y) * away;
    return mix(light.floor, wall, smooth(flat / light.floor_extent));
}

struct Encoder {
    uint8_t table[4097];
    Encoder() {
        for (int k = 0; k <= 4096; ++k) {
            // sRGB, with a shoulder so that light parts do not burn out. x^(1/2.4) by Newton's method: x = y^2.4, y^12 = x^5.
            double x = k / 4096.0 * 2.0;
            x = x * (1 + 0.15 * x) / (1 + 0.72 * x);
            x = std::min(1.0, x);
            double y = 12.92 * x;
            if (x > 0.0031308) {
                double r = std::sqrt(x), goal = x * x * x * x * x;
                for (int i = 0; i < 60; ++i) {
                    double r4 = r * r * r * r, r11 = r4 * r4 * r * r * r;
                    r -= (r11 * r - goal) / (12 * r11);
                }
                y = 1.055 * r - 0.055;
            }
            table[k] = uint8_t(std::min(255.0, std::max(0.0, 255 * y + 0.5)));
        }
    }
    uint8_t operator()(float x) const {
        return table[x > 0 ? std::min(4096, int(x * 2048.0f + 0.5f)) : 0];
    }
};

struct Eye {
    const Call& call;
    const Camera camera;
    const Light light;
    const Mesh& mesh;
    const Shadow& shadow;
    int64_t b;
    int step;  // samples along an axis
    std::vector<Vec> local;
    Buffer buffer;

    // Place in the buffer of a place in the picture: samples are at the middles of the parts of a pixel.
    float across(float x) const { return step == 1 ? x : 2 * x + 0.5f; }
    Corner corner(Vec p) const {
        float w = 1 / p.z;
        return {across(camera.fx * p.x * w + camera.cx), across(camera.fy * p.y * w + camera.cy), w};
    }

    void fill(const std::vector<Span>& spans) {
        const int width = int(call.width), height = int(call.height);
        buffer.clear(width * step, height * step);
        local.resize(mesh.pos.size());
        std::vector<Corner> at(mesh.pos.size());
        for (const Span& s : spans) {
            if (!camera.sees(s.middle, s.reach, width, height)) continue;
            bool clipped = false;
            for (int32_t k = s.first_vertex; k < s.last_vertex; ++k) {
                local[k] = camera.local(mesh.pos[k]);
                if (local[k].z > NEAR) at[k] = corner(local[k]);
                else clipped = true;
            }
            const bool both = s.flags & TWO_SIDED;
            for (int32_t k = s.first_face; k < s.last_face; ++k) {
                const int32_t* f = &mesh.face[3 * k];
                if (!clipped || (local[f[0]].z > NEAR && local[f[1]].z > NEAR && local[f[2]].z > NEAR))
                    draw<true>(at[f[0]], at[f[1]], at[f[2]], uint32_t(k), both, buffer.width, buffer.height,
                               buffer.near.data(), buffer.number.data());
                else clip(f, uint32_t(k), both);
            }
        }
        balls();
    }

    // Draw what of a triangle is before the camera.
    void clip(const int32_t* f, uint32_t number, bool both) {
        Corner kept[4];
        int count = 0;
        for (int k = 0; k < 3; ++k) {
            Vec a = local[f[k]], b = local[f[(k + 1) % 3]];
            if (a.z > NEAR) kept[count++] = corner(a);
            if ((a.z > NEAR) != (b.z > NEAR)) {
                Vec cut = mix(a, b, (NEAR - a.z) / (b.z - a.z));
                cut.z = NEAR;
                kept[count++] = corner(cut);
            }
        }
        for (int k = 2; k < count; ++k)
            draw<true>(kept[0], kept[k - 1], kept[k], number, both, buffer.width, buffer.height, buffer.near.data(),
                       buffer.number.data());
    }

    Vec ball(uint32_t k) const { return camera.local(load(call.particle_pos + 3 * (call.particles * b + k))); }

    void balls() {
        const uint32_t start = uint32_t(mesh.owner.size());
        for (int64_t k = 0; k < call.particles; ++k) {
            Vec p = ball(uint32_t(k));
            float r = call.particle_radius[k];
            if (p.z - r <= NEAR) continue;
            Corner c = corner(p);
            float rx = step * camera.fx * r / p.z, ry = step * camera.fy * r / p.z;
            int x0 = int(std::ceil(std::max(0.0f, c.x - rx))), y0 = int(std::ceil(std::max(0.0f, c.y - ry)));
            float x1 = std::min(float(buffer.width - 1), c.x + rx), y1 = std::min(float(buffer.height - 1), c.y + ry);
            for (int y = y0; float(y) <= y1; ++y)
                for (int x = x0; float(x) <= x1; ++x) {
                    float dx = (x - c.x) / rx, dy = (y - c.y) / ry, d = dx * dx + dy * dy;
                    if (d > 1) continue;
                    float w = 1 / (p.z - r * std::sqrt(1 - d));
                    size_t at = size_t(y) * buffer.width + x;
                    if (w > buffer.near[at]) buffer.near[at] = w, buffer.number[at] = start + uint32_t(k);
                }
        }
    }

    int16_t id(uint32_t number) const {
        if (number == NONE) return 0;
        if (number >= mesh.owner.size()) return call.group_id[call.particle_group[number - mesh.owner.size()]];
        int32_t owner = mesh.owner[number];
        return owner < call.pieces ? call.piece_id[owner] : call.rope_id[owner - call.pieces];
    }

    // Colour of what a triangle shows at a place of the picture.
    Vec color(uint32_t number, float x, float y) const {
        const Vec ray{(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1};
        if (number == NONE) return behind(light, camera.eye, unit(camera.back(ray)));
        if (number >= mesh.owner.size()) {
            const uint32_t k = number - uint32_t(mesh.owner.size());
            Vec c = ball(k);
            float r = call.particle_radius[k], dx = (ray.x - c.x / c.z) * c.z / r, dy = (ray.y - c.y / c.z) * c.z / r;
            float d = std::min(0.98f, dx * dx + dy * dy);
            Vec n = camera.back(unit({dx, dy, -std::sqrt(1 - d)}));
            Vec p = camera.back(c - camera.shift) + r * n;
            const float* m = call.group_material + MATERIAL * (b * call.groups + call.particle_group[k]);
            return shaded(light, shadow, p, n, unit(camera.eye - p), load(m), m[6]);
        }
        const int32_t *f = &mesh.face[3 * number], owner = mesh.owner[number];
        const Vec a = local[f[0]], e = local[f[1]] - a, g = local[f[2]] - a;
        // Moller and Trumbore 1997.
        const Vec h = cross(ray, g), q = cross(-1.0f * a, e);
        const float det = dot(e, h), over = det != 0 ? 1 / det : 0.0f;
        float u = dot(-1.0f * a, h) * over, v = dot(ray, q) * over;
        // Surfaces are shaded within their triangles.
        u = clamp01(u), v = clamp01(v);
        if (u + v > 1) {
            float s = 1 / (u + v);
            u *= s, v *= s;
        }
        const float t = 1 - u - v;
        const Vec p = t * mesh.pos[f[0]] + u * mesh.pos[f[1]] + v * mesh.pos[f[2]];
        const Vec n = unit(t * mesh.normal[f[0]] + u * mesh.normal[f[1]] + v * mesh.normal[f[2]]);
        const Vec out = camera.eye - p;
        const float away = std::sqrt(dot(out, out));
        const Vec to_eye = (1 / std::max(away, 1e-9f)) * out;
        const float blur = away / camera.fx / std::max(0.15f, std::fabs(dot(n, to_eye)));
        float s = 0, along = 0;
        const float* m;
        if (owner < call.pieces) {
            m = call.piece_material + MATERIAL * (b * call.pieces + owner);
        } else {
            m = call.rope_material + MATERIAL * (b * call.ropes + owner - call.pieces);
            const float* w = mesh.uv.data();
            const int64_t o = mesh.rope_vertex;
            s = t * w[2 * (f[0] - o)] + u * w[2 * (f[1] - o)] + v * w[2 * (f[2] - o)];
            along = t * w[2 * (f[0] - o) + 1] + u * w[2 * (f[1] - o) + 1] + v * w[2 * (f[2] - o) + 1];
        }
        return shaded(light, shadow, p, n, to_eye, painted(m, p, s, along, blur), m[6]);
    }

    void resolve(int64_t image, const Encoder& encode) const {
        const int width = int(call.width), height = int(call.height), count = step * step;
        for (int y = 0; y < height; ++y)
            for (int x = 0; x < width; ++x) {
                uint32_t number[4];
                float near[4];
                for (int k = 0; k < count; ++k) {
                    size_t at = size_t(y * step + k / step) * buffer.width + x * step + k % step;
                    number[k] = buffer.number[at], near[k] = buffer.near[at];
                }
                const size_t pixel = (size_t(image) * height + y) * width + x;
                if (call.ids || call.depth) masks(number, near, count, pixel);
                if (!call.rgb) continue;
                Vec sum{0, 0, 0};
                bool done[4] = {};
                for (int k = 0; k < count; ++k) {
                    if (done[k]) continue;
                    // Samples that see the same surface are shaded together, in their middle.
                    float mx = 0, my = 0;
                    int many = 0;
                    for (int j = k; j < count; ++j) {
                        if (done[j] || !same(number[k], near[k], number[j], near[j])) continue;
                        done[j] = true, ++many;
                        if (step == 2) mx += 0.5f * (j % 2) - 0.25f, my += 0.5f * (j / 2) - 0.25f;
                    }
                    sum = sum + float(many) * color(number[k], x + mx / many, y + my / many);
                }
                sum = (1.0f / count) * sum;
                uint8_t* out = call.rgb + 3 * pixel;
                out[0] = encode(sum.x), out[1] = encode(sum.y), out[2] = encode(sum.z);
            }
    }

    bool same(uint32_t a, float near_a, uint32_t b, float near_b) const {
        if (a == b) return true;
        const uint32_t many = uint32_t(mesh.owner.size());
        if (a >= many || b >= many || mesh.owner[a] != mesh.owner[b]) return false;
        return std::fabs(near_a - near_b) < 0.004f * near_a;
    }

    // The number that most samples see, the first of equals, and its mean depth.
    void masks(const uint32_t* number, const float* near, int count, size_t pixel) const {
        int16_t all[4];
        for (int k = 0; k < count; ++k) all[k] = id(number[k]);
        int best = 0, most = 0;
        for (int k = 0; k < count; ++k) {
            int votes = 0;
            for (int j = 0; j < count; ++j) votes += all[j] == all[k];
            if (votes > most) most = votes, best = k;
        }
        if (call.ids) call.ids[pixel] = all[best];
        if (!call.depth) return;
        float sum = 0;
        for (int k = 0; k < count; ++k)
            if (all[k] == all[best]) sum += near[k];
        call.depth[pixel] = sum > 0 ? float(most) / sum : INFINITY;
    }
};

}  // namespace

extern "C" void render(const Call* given, int threads) {
    const Call& call = *given;
    static const Encoder encode;
    const int step = call.samples == 4 ? 2 : 1;
#pragma omp parallel for schedule(dynamic) num_threads(threads)
    for (int64_t b = 0; b < call.batch; ++b) {
        Mesh mesh;
        std::vector<Span> spans;
        Shadow shadow;
        const Light light(call.light + LIGHT * b);
        place(call, b, mesh, spans);
        if (call.rgb && call.shadow) {
            place_ropes(call, b, float(call.shadow) / 4, mesh, spans);
            shadow.draw_all(call, b, mesh, spans, light.key_to);
        }
        for (int64_t c = 0; c < call.cameras; ++c) {
            const Camera camera(call.camera + CAMERA * (b * call.cameras + c));
            float pixels = 0;
            if (call.detail) {
                // By the vertex of a rope that is nearest, if it is before the camera at all.
                float nearest = 1e30f;
                for (int64_t k = 0; k < call.slots; ++k) {
                    float z = camera.local(load(call.rope_pos + 3 * (call.slots * b + k))).z;
                    if (z > 0.02f) nearest = std::min(nearest, z);
                }
                pixels = std::max(camera.fx, camera.fy) / nearest;
            }
            place_ropes(call, b, pixels, mesh, spans);
            Eye eye{call, camera, light, mesh, shadow, b, step, {}, {}};
            eye.fill(spans);
            eye.resolve(b * call.cameras + c, encode);
        }
    }
}
