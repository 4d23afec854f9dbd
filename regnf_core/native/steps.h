/* Residuals of a pair of surfaces at a batch of poses, and sums of kernels: what regnf_core/robust/residuals.py and
 * verdict/covariance.py say in tensor algebra, in one pass over the samples. */
#ifndef REGNF_STEPS_H
#define REGNF_STEPS_H

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "block.h"
#include "distances.h"

enum { STATE_UNSEEN = 0, STATE_FREE = 1, STATE_SURFACE = 2 }; /* as in regnf_core/schema/description.py */

typedef struct {
    float s, R[9], t[3], offset;
} pose;

INLINE pose pose_of(const regnf_poses *T, int64_t h) {
    pose p = {.s = (float)T->scale[h], .offset = T->offset ? (float)T->offset[h] : 0.0f};
    for (int k = 0; k < 9; k++) p.R[k] = (float)T->rotation[9 * h + k];
    for (int k = 0; k < 3; k++) p.t[k] = (float)T->translation[3 * h + k];
    return p;
}

INLINE void turn3(const float *R, const float *x, float *y) {
    for (int i = 0; i < 3; i++) y[i] = dot3(R + 3 * i, x);
}

INLINE void turn_back3(const float *R, const float *x, float *y) {
    for (int i = 0; i < 3; i++) y[i] = R[i] * x[0] + R[3 + i] * x[1] + R[6 + i] * x[2];
}

/* What follows from a pose for one of the scene's samples: y - t, and the normal in the object's frame. */
INLINE void carry_scene(const regnf_samples *a, const pose *T, int64_t i, float *arm, float *normal) {
    turn3(T->R, a->points + 3 * i, arm);
    for (int k = 0; k < 3; k++) arm[k] *= T->s;
    turn3(T->R, a->normals + 3 * i, normal);
}

/* For one of the object's samples: z - t, and w. */
INLINE void carry_object(const regnf_samples *a, const pose *T, int64_t i, float *arm, float *w) {
    for (int k = 0; k < 3; k++) arm[k] = a->points[3 * i + k] - T->t[k];
    turn_back3(T->R, arm, w);
    for (int k = 0; k < 3; k++) w[k] /= T->s;
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

/* A pose's row: its values, Jacobian (or NULL), cosines and flags (or NULL). */
typedef struct {
    float *values, *jacobian, *cosines;
    uint8_t *unobserved;
} row;

INLINE row row_of(const regnf_rows *rows, int64_t number, int64_t total) {
    row found = {.values = rows->values + number * total, .cosines = rows->cosines + number * total};
    if (rows->jacobian) found.jacobian = rows->jacobian + 7 * number * total;
    if (rows->unobserved) found.unobserved = rows->unobserved + number * total;
    return found;
}

static void scene_places(const regnf_pair *pair, const pose *T, float *out) {
    const regnf_samples *a = &pair->scene_samples;
    const float step = pair->ahead * T->s;
    for (int64_t i = 0; i < a->count; i++, out += 3) {
        float arm[3], normal[3];
        carry_scene(a, T, i, arm, normal);
        for (int k = 0; k < 3; k++) out[k] = arm[k] + T->t[k] + step * normal[k];
    }
}

static void object_places(const regnf_pair *pair, const pose *T, float *out) {
    for (int64_t i = 0; i < pair->object_samples.count; i++, out += 3) {
        float arm[3];
        carry_object(&pair->object_samples, T, i, arm, out);
    }
}

static void scene_rows(const regnf_pair *pair, const pose *T, const float *value, const float *g, row to) {
    const regnf_samples *a = &pair->scene_samples;
    const int64_t total = a->count + pair->object_samples.count;
    for (int64_t i = 0; i < a->count; i++, g += 3) {
        float arm[3], normal[3];
        carry_scene(a, T, i, arm, normal);
        const float v = value[i] - pair->ahead * T->s * dot3(g, normal);
        to.values[i] = v - T->s * a->values[i] - T->offset;
        if (to.jacobian) write_row(to.jacobian + i, total, arm, g, dot3(g, arm) - v);
        to.cosines[i] = cosine_of(g, normal);
        if (to.unobserved) to.unobserved[i] = pair->hidden && pair->hidden[i] && to.cosines[i] < pair->min_cosine;
    }
}

static void object_rows(const regnf_pair *pair, const pose *T, const float *value, const float *g, row to) {
    const regnf_samples *a = &pair->object_samples;
    const int64_t first = pair->scene_samples.count, total = first + a->count;
    for (int64_t i = 0; i < a->count; i++, g += 3) {
        float arm[3], place[3], turned[3], away[3], normal[3];
        carry_object(a, T, i, arm, place);
        turn3(T->R, g, turned);
        for (int k = 0; k < 3; k++) away[k] = -turned[k];
        const float r = T->s * value[i] - a->values[i], cosine = cosine_of(turned, a->normals + 3 * i);
        to.values[first + i] = r + T->offset;
        if (to.jacobian) write_row(to.jacobian + first + i, total, arm, away, a->values[i] - dot3(turned, arm));
        to.cosines[first + i] = cosine;
        if (!to.unobserved) continue;
        const int state = state_at(pair->seen, place);
        int blind = state == STATE_UNSEEN || (state == STATE_SURFACE && fabsf(r) > pair->seen->agreement);
        if (!blind && cosine < pair->min_cosine) {
            turn_back3(T->R, a->normals + 3 * i, normal);
            blind = front_unobserved(pair->seen, place, normal);
        }
        to.unobserved[first + i] = (uint8_t)blind;
    }
}

static int64_t samples_of(const regnf_pair *pair, int of_object) {
    return of_object ? pair->object_samples.count : pair->scene_samples.count;
}

/* Of so many poses from the first on. */
static void places_of(const regnf_pair *pair, const regnf_poses *T, int of_object, int64_t first, int64_t poses,
                      float *out) {
    for (int64_t h = 0; h < poses; h++) {
        const pose at = pose_of(T, first + h);
        (of_object ? object_places : scene_places)(pair, &at, out + 3 * h * samples_of(pair, of_object));
    }
}

/* The same; that of pose h goes to row numbers[h], or h. */
static void rows_from(const regnf_pair *pair, const regnf_poses *T, int of_object, int64_t first, int64_t poses,
                      const regnf_rows *rows, const int64_t *numbers, const float *value, const float *gradient) {
    const int64_t count = samples_of(pair, of_object), total = samples_of(pair, 0) + samples_of(pair, 1);
    for (int64_t h = 0; h < poses; h++) {
        const pose at = pose_of(T, first + h);
        const row to = row_of(rows, numbers ? numbers[first + h] : first + h, total);
        (of_object ? object_rows : scene_rows)(pair, &at, value + h * count, gradient + 3 * h * count, to);
    }
}

/* Residuals of one surface's samples at all poses. */
static int fill_rows(const regnf_pair *pair, const regnf_poses *T, int of_object, const regnf_rows *rows,
                     const int64_t *numbers, const float *value, const float *gradient) {
    if (value != NULL) {
        rows_from(pair, T, of_object, 0, T->count, rows, numbers, value, gradient);
        return REGNF_DONE;
    }
    const regnf_model *model = of_object ? pair->scene : pair->object;
    const int64_t count = samples_of(pair, of_object);
    const int64_t few = count > 0 && model->at_once < T->count * count ? model->at_once / count : T->count;
    const int64_t step = few > 1 ? few : 1;
    float *memory = malloc((size_t)(7 * step * count + 1) * sizeof(float));
    if (memory == NULL) return REGNF_NO_MEMORY;
    float *asked = memory + 3 * step * count, *slopes = asked + step * count;
    int fault = REGNF_DONE;
    for (int64_t first = 0; first < T->count && fault == REGNF_DONE; first += step) {
        const int64_t poses = T->count - first < step ? T->count - first : step;
        places_of(pair, T, of_object, first, poses, memory);
        fault = ask_model(model, memory, poses * count, asked, slopes);
        if (fault == REGNF_DONE) rows_from(pair, T, of_object, first, poses, rows, numbers, asked, slopes);
    }
    free(memory);
    return fault;
}

static void places(const regnf_pair *pair, const regnf_poses *T, int of_object, float *out) {
    places_of(pair, T, of_object, 0, T->count, out);
}

static int fill(const regnf_pair *pair, const regnf_poses *T, int of_object, const regnf_rows *rows, const float *value,
                const float *gradient) {
    return fill_rows(pair, T, of_object, rows, NULL, value, gradient);
}

#define STRIP 256 /* samples at once: what is worked out of them stays in the nearest cache */

typedef float strip[STRIP] __attribute__((aligned(64)));

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
