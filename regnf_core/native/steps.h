/* The inner steps of search and refinement on the samples of one surface, at a batch of poses: what
 * regnf_core/robust/residuals.py, search/distance_grid.py and refine/loss.py say in tensor algebra, in one pass each. */
#ifndef REGNF_STEPS_H
#define REGNF_STEPS_H

#include <math.h>
#include <string.h>

#include "block.h"
#include "near.h"

enum { STATE_UNSEEN = 0, STATE_FREE = 1, STATE_SURFACE = 2 }; /* as in regnf_core/schema/description.py */

INLINE float dot3(const float *a, const float *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

INLINE void turn3(const float *R, const float *x, float *y) {
    for (int i = 0; i < 3; i++) y[i] = dot3(R + 3 * i, x);
}

INLINE void turn_back3(const float *R, const float *x, float *y) {
    for (int i = 0; i < 3; i++) y[i] = R[i] * x[0] + R[3 + i] * x[1] + R[6 + i] * x[2];
}

/* What follows from a pose for one of the scene's samples: y - t, and the normal in the object's frame. */
INLINE void carry_scene(const regnf_samples *a, int64_t h, int64_t i, float *arm, float *normal) {
    turn3(a->rotation + 9 * h, a->points + 3 * i, arm);
    for (int k = 0; k < 3; k++) arm[k] *= a->scale[h];
    turn3(a->rotation + 9 * h, a->normals + 3 * i, normal);
}

/* For one of the object's samples: z - t, and w. */
INLINE void carry_object(const regnf_samples *a, int64_t h, int64_t i, float *arm, float *w) {
    for (int k = 0; k < 3; k++) arm[k] = a->points[3 * i + k] - a->translation[3 * h + k];
    turn_back3(a->rotation + 9 * h, arm, w);
    for (int k = 0; k < 3; k++) w[k] /= a->scale[h];
}

static void places(const regnf_samples *a, float *out) {
    for (int64_t h = 0; h < a->poses; h++)
        for (int64_t i = 0; i < a->count; i++, out += 3) {
            float arm[3], other[3];
            if (a->of_object) {
                carry_object(a, h, i, arm, out);
                continue;
            }
            carry_scene(a, h, i, arm, other);
            const float step = a->ahead * a->scale[h];
            for (int k = 0; k < 3; k++) out[k] = arm[k] + a->translation[3 * h + k] + step * other[k];
        }
}

/* [arm x g, g, lever] of a sample, in planes `total` apart. */
INLINE void write_row(float *J, int64_t total, const float *arm, const float *g, float lever) {
    for (int k = 0; k < 3; k++) {
        const int i = (k + 1) % 3, j = (k + 2) % 3;
        J[k * total] = arm[i] * g[j] - arm[j] * g[i];
        J[(3 + k) * total] = g[k];
    }
    J[6 * total] = lever;
}

INLINE float cosine_of(const float *g, const float *normal) {
    const float length = sqrtf(dot3(g, g));
    return dot3(g, normal) / (length < 1e-6f ? 1e-6f : length);
}

INLINE int state_at(const regnf_observation *seen, const float *p) {
    int64_t cell[3];
    for (int k = 0; k < 3; k++) {
        const float c = floorf(p[0] * seen->turn[k] + p[1] * seen->turn[3 + k] + p[2] * seen->turn[6 + k] + seen->shift[k]);
        if (!(c >= 0.0f && c < (float)seen->counts[k])) return STATE_UNSEEN;
        cell[k] = (int64_t)c;
    }
    return seen->states[(cell[0] * seen->counts[1] + cell[1]) * seen->counts[2] + cell[2]];
}

INLINE int front_unobserved(const regnf_observation *seen, const float *p, const float *normal) {
    for (int part = 1; part <= 2; part++) {
        float q[3];
        for (int k = 0; k < 3; k++) q[k] = p[k] + (part == 1 ? 0.5f : 1.0f) * (seen->ahead * normal[k]);
        if (state_at(seen, q) == STATE_FREE) return 0;
    }
    return 1;
}

static void sample_residuals(const regnf_samples *a, const float *value, const float *gradient, const regnf_rows *out,
                             const regnf_observation *seen, const uint8_t *hidden) {
    for (int64_t h = 0; h < a->poses; h++) {
        const float *R = a->rotation + 9 * h, s = a->scale[h];
        for (int64_t i = 0; i < a->count; i++) {
            const int64_t from = h * a->count + i, to = h * out->total + out->first + i;
            float *J = out->jacobian + 7 * h * out->total + out->first + i;
            const float *g = gradient + 3 * from;
            float arm[3], other[3], v = value[from];
            if (!a->of_object) {
                carry_scene(a, h, i, arm, other);
                v -= a->ahead * s * dot3(g, other);
                out->values[to] = v - s * a->values[i];
                write_row(J, out->total, arm, g, dot3(g, arm) - v);
                out->cosines[to] = cosine_of(g, other);
                if (out->unobserved) out->unobserved[to] = hidden && hidden[i] && out->cosines[to] < a->min_cosine;
                continue;
            }
            float turned[3], away[3], normal[3];
            carry_object(a, h, i, arm, other);
            turn3(R, g, turned);
            for (int k = 0; k < 3; k++) away[k] = -turned[k];
            const float r = s * v - a->values[i];
            out->values[to] = r;
            write_row(J, out->total, arm, away, a->values[i] - dot3(turned, arm));
            out->cosines[to] = cosine_of(turned, a->normals + 3 * i);
            if (!seen) continue;
            const int state = state_at(seen, other);
            int blind = state == STATE_UNSEEN || (state == STATE_SURFACE && fabsf(r) > seen->agreement);
            if (!blind && out->cosines[to] < a->min_cosine) {
                turn_back3(R, a->normals + 3 * i, normal);
                blind = front_unobserved(seen, other, normal);
            }
            out->unobserved[to] = (uint8_t)blind;
        }
    }
}

static void grid_distances(const regnf_planes *grid, const float *points, int64_t count, float *value, float *gradient) {
    const int64_t cells = grid->cells;
    for (int64_t p = 0; p < count; p++, points += 3, gradient += 3) {
        float inside[3], beyond[3], squares = 0.0f;
        int64_t cell[3];
        for (int k = 0; k < 3; k++) {
            const float low = grid->low[k], high = grid->high[k], x = points[k];
            inside[k] = x < low ? low : x > high ? high : x;
            const float c = (inside[k] - low) / grid->edge[k];
            cell[k] = c >= (float)cells ? cells - 1 : c > 0.0f ? (int64_t)c : 0; /* of NaN, too */
            beyond[k] = x - inside[k];
            squares += beyond[k] * beyond[k];
        }
        const float *plane = grid->planes + 4 * ((cell[0] * cells + cell[1]) * cells + cell[2]);
        memcpy(gradient, plane + 1, 3 * sizeof(float));
        value[p] = plane[0] + dot3(plane + 1, inside);
        if (squares == 0.0f) continue;
        const float distance = sqrtf(squares);
        value[p] += distance;
        for (int k = 0; k < 3; k++) gradient[k] = beyond[k] / (distance < 1e-9f ? 1e-9f : distance);
    }
}

#define STRIP 256 /* samples at once: what is worked out of them stays in the nearest cache */

typedef float strip[STRIP] __attribute__((aligned(64)));

/* Of samples `first` on of pose h: the kernel's agreement, how well the normals agree, the kernel's width as a part of
 * that of others, and the share in the mean over both surfaces; 0 beyond the last sample. */
typedef struct {
    strip agreement, facing, rate, share;
} judged;

static void judge(const regnf_loss *l, int64_t h, int64_t first, int64_t live, judged *out) {
    const float *values = l->values + h * l->total + first, *cosines = l->cosines + h * l->total + first;
    const uint8_t *blind = l->unobserved ? l->unobserved + h * l->total + first : NULL;
    const float width = l->widths[h], narrow = l->unobserved_width;
    const float of_scene = 1.0f / (float)l->scene_count, of_object = 1.0f / (float)(l->total - l->scene_count);
    const float observed = l->observed_weights ? l->observed_weights[h] : 1.0f;
    for (int64_t i = 0; i < STRIP; i++) {
        out->rate[i] = 1.0f;
        out->share[i] = i >= live ? 0.0f : first + i < l->scene_count ? of_scene : observed * of_object;
    }
    if (blind)
        for (int64_t i = 0; i < live; i++) {
            out->rate[i] = blind[i] ? narrow : 1.0f;
            const float as_others = first + i < l->scene_count ? of_scene : of_object;
            out->share[i] = blind[i] ? as_others : out->share[i];
        }
    for (int64_t i = 0; i < live; i++) {
        const float own = out->rate[i] * width, squares = own * own;
        out->agreement[i] = squares / (values[i] * values[i] + squares);
        const float facing = cosines[i] / l->min_cosine;
        out->facing[i] = facing < 0.0f ? 0.0f : facing > 1.0f ? 1.0f : facing;
    }
    for (int64_t i = live; i < STRIP; i++) out->agreement[i] = out->facing[i] = 0.0f;
    if (!l->normals)
        for (int64_t i = 0; i < STRIP; i++) out->facing[i] = 1.0f;
}

/* The sum of products. In vectors, as the compiler may not change the order of sums. */
INLINE float strip_dot(const float *a, const float *b) {
    vector sums = {0};
    for (int i = 0; i < STRIP; i += WIDE) {
        vector x, y;
        memcpy(&x, a + i, sizeof x);
        memcpy(&y, b + i, sizeof y);
        sums += x * y;
    }
    float total = 0.0f;
    for (int k = 0; k < WIDE; k++) total += sums[k];
    return total;
}

static void costs(const regnf_loss *l, double *cost) {
    judged one;
    strip loss;
    for (int64_t h = 0; h < l->poses; h++) {
        cost[h] = 0.0;
        for (int64_t first = 0; first < l->total; first += STRIP) {
            judge(l, h, first, l->total - first < STRIP ? l->total - first : STRIP, &one);
            for (int i = 0; i < STRIP; i++)
                loss[i] = (1.0f - one.agreement[i] * one.facing[i]) * (one.rate[i] * one.rate[i]);
            cost[h] += 0.5 * (double)strip_dot(one.share, loss);
        }
    }
}

static void normal_equations(const regnf_loss *l, const float *jacobian, double *H, double *b) {
    const int size = l->with_offset ? 8 : 7;
    judged one;
    strip rows[9], weighted[8]; /* the unknowns, then the residuals */
    memset(H, 0, sizeof(double) * (size_t)(l->poses * size * size));
    memset(b, 0, sizeof(double) * (size_t)(l->poses * size));
    for (int64_t h = 0; h < l->poses; h++, H += size * size, b += size)
        for (int64_t first = 0; first < l->total; first += STRIP) {
            const int64_t live = l->total - first < STRIP ? l->total - first : STRIP;
            judge(l, h, first, live, &one);
            if (live < STRIP) memset(rows, 0, sizeof rows);
            for (int k = 0; k < 7; k++)
                memcpy(rows[k], jacobian + (7 * h + k) * l->total + first, (size_t)live * sizeof(float));
            memcpy(rows[8], l->values + h * l->total + first, (size_t)live * sizeof(float));
            for (int64_t i = 0; i < live; i++) rows[7][i] = first + i < l->scene_count ? -1.0f : 1.0f;
            for (int i = 0; i < STRIP; i++) one.share[i] *= one.agreement[i] * one.agreement[i] * one.facing[i];
            for (int k = 0; k < size; k++) {
                for (int i = 0; i < STRIP; i++) weighted[k][i] = one.share[i] * rows[k][i];
                for (int j = 0; j <= k; j++) H[k * size + j] += (double)strip_dot(weighted[k], rows[j]);
                b[k] += (double)strip_dot(weighted[k], rows[8]);
            }
            for (int k = 0; k < size; k++)
                for (int j = 0; j < k; j++) H[j * size + k] = H[k * size + j];
        }
}

/* (n, n): sums over `lengths` of weights times exp(factor |x_i - x_j|^2 - |u_i - u_j|^2 / 2); x, u: planes (3, n). */
static void kernel_sums(const float *x, const float *u, int64_t n, const float *factors, const float *weights,
                        int64_t lengths, float *out) {
    float *const sums = out;
    memset(out, 0, sizeof(float) * (size_t)(n * n));
    for (int64_t i = 0; i < n; i++, out += n)
        for (int64_t first = 0; first <= i; first += STRIP) {
            const int64_t live = n - first < STRIP ? n - first : STRIP;
            strip places, turned;
            for (int64_t j = 0; j < live; j++) {
                float at[3], to[3];
                for (int k = 0; k < 3; k++) {
                    at[k] = x[k * n + first + j] - x[k * n + i];
                    to[k] = u[k * n + first + j] - u[k * n + i];
                }
                places[j] = dot3(at, at);
                turned[j] = -0.5f * dot3(to, to);
            }
            for (int64_t l = 0; l < lengths; l++)
                for (int64_t j = 0; j < live; j++) {
                    const float power = factors[l] * places[j] + turned[j];
                    out[first + j] += weights[l] * exp_of(power < -87.0f ? -87.0f : power);
                }
        }
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j < i; j++) sums[j * n + i] = sums[i * n + j];
}

#endif
