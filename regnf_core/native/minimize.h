/* Levenberg-Marquardt on Sim(3) for many poses at once: what regnf_core/robust/refine says in tensor algebra. */
#ifndef REGNF_MINIMIZE_H
#define REGNF_MINIMIZE_H

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "steps.h"

/* What a pose's residuals are judged by. observed: what an object sample that was observed weighs. */
typedef struct {
    int64_t total, scene_count;
    int32_t normals;
    float width, narrow, min_cosine, observed;
} kernel;

/* Of samples `first` on: the kernel's agreement, how well the normals agree, the kernel's width as a part of that of
 * others, and the share in the mean over both surfaces; 0 beyond the last sample. */
typedef struct {
    strip agreement, facing, rate, share;
} judged;

static void judge(const kernel *l, const row *r, int64_t first, int64_t live, judged *out) {
    const float *values = r->values + first, *cosines = r->cosines + first;
    const float of_scene = 1.0f / (float)l->scene_count, of_object = 1.0f / (float)(l->total - l->scene_count);
    for (int64_t i = 0; i < STRIP; i++) {
        out->rate[i] = 1.0f;
        out->share[i] = i >= live ? 0.0f : first + i < l->scene_count ? of_scene : l->observed * of_object;
    }
    if (r->unobserved) {
        const uint8_t *blind = r->unobserved + first;
        for (int64_t i = 0; i < live; i++) {
            out->rate[i] = blind[i] ? l->narrow : 1.0f;
            const float as_others = first + i < l->scene_count ? of_scene : of_object;
            out->share[i] = blind[i] ? as_others : out->share[i];
        }
    }
    for (int64_t i = 0; i < live; i++) {
        const float own = out->rate[i] * l->width, squares = own * own;
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

/* The robust cost; with `limit`, the loss of samples that were not observed is at most so large, and their kernel as
 * wide as that of others. */
static double cost_of(const kernel *l, const row *r, float limit) {
    judged one;
    strip loss;
    double cost = l->scene_count > 0 && l->scene_count < l->total ? 0.0 : NAN; /* a mean of nothing */
    for (int64_t first = 0; first < l->total; first += STRIP) {
        const int64_t live = l->total - first < STRIP ? l->total - first : STRIP;
        judge(l, r, first, live, &one);
        for (int i = 0; i < STRIP; i++)
            loss[i] = (1.0f - one.agreement[i] * one.facing[i]) * (one.rate[i] * one.rate[i]);
        if (limit > 0.0f && r->unobserved)
            for (int64_t i = 0; i < live; i++)
                loss[i] = r->unobserved[first + i] && loss[i] > limit ? limit : loss[i];
        cost += 0.5 * (double)strip_dot(one.share, loss);
    }
    return cost;
}

/* J^T W J and J^T W r of `size` unknowns. */
static void normal_equations(const kernel *l, const row *r, int size, double *H, double *b) {
    judged one;
    strip rows[9], weighted[8]; /* the unknowns, then the residuals */
    memset(H, 0, sizeof(double) * (size_t)(size * size));
    memset(b, 0, sizeof(double) * (size_t)size);
    for (int64_t first = 0; first < l->total; first += STRIP) {
        const int64_t live = l->total - first < STRIP ? l->total - first : STRIP;
        judge(l, r, first, live, &one);
        if (live < STRIP) memset(rows, 0, sizeof rows);
        for (int k = 0; k < 7; k++) memcpy(rows[k], r->jacobian + k * l->total + first, (size_t)live * sizeof(float));
        memcpy(rows[8], r->values + first, (size_t)live * sizeof(float));
        for (int64_t i = 0; i < live; i++) rows[7][i] = first + i < l->scene_count ? -1.0f : 1.0f;
        for (int i = 0; i < STRIP; i++) one.share[i] *= one.agreement[i] * one.agreement[i] * one.facing[i];
        for (int k = 0; k < size; k++) {
            for (int i = 0; i < STRIP; i++) weighted[k][i] = one.share[i] * rows[k][i];
            for (int j = 0; j <= k; j++) H[k * size + j] += (double)strip_dot(weighted[k], rows[j]);
            b[k] += (double)strip_dot(weighted[k], rows[8]);
        }
    }
    for (int k = 0; k < size; k++)
        for (int j = 0; j < k; j++) H[j * size + k] = H[k * size + j];
}

/* Means of a row's |values| over both surfaces. */
static void mean_sizes(const kernel *l, const row *r, float *of_scene, float *of_object) {
    double sums[2] = {0.0, 0.0};
    for (int64_t i = 0; i < l->total; i++) sums[i >= l->scene_count] += (double)fabsf(r->values[i]);
    *of_scene = (float)(sums[0] / (double)l->scene_count);
    *of_object = (float)(sums[1] / (double)(l->total - l->scene_count));
}

/* What an object sample that was observed weighs: as if all of the object had been. */
static float observed_weight(const kernel *l, const row *r, float least) {
    if (!r->unobserved) return 1.0f;
    int64_t seen = 0;
    for (int64_t i = l->scene_count; i < l->total; i++) seen += !r->unobserved[i];
    const float share = (float)seen / (float)(l->total - l->scene_count);
    return 1.0f / (share < least ? least : share);
}

/* The quantile of |values|, linear between the two nearest; scratch: (count). Of numbers' bits, which are ordered as
 * the numbers, and NaN is larger than all. */
static float quantile_of_sizes(const float *values, int64_t count, double q, uint32_t *scratch) {
    for (int64_t i = 0; i < count; i++) scratch[i] = (uint32_t)bits_of(fabsf(values[i]));
    const double rank = q * (double)(count - 1);
    const int64_t wanted = (int64_t)rank;
    int64_t low = 0, high = count - 1;
    while (low < high) { /* Hoare's selection: scratch[wanted] is what it is in order, and none after it is less */
        const uint32_t middle = scratch[low + (high - low) / 2];
        int64_t i = low, j = high;
        while (i <= j) {
            while (scratch[i] < middle) i++;
            while (scratch[j] > middle) j--;
            if (i > j) break;
            const uint32_t held = scratch[i];
            scratch[i++] = scratch[j];
            scratch[j--] = held;
        }
        if (wanted <= j) high = j;
        else if (wanted >= i) low = i;
        else break;
    }
    uint32_t next = scratch[wanted], most = scratch[wanted];
    if (wanted + 1 < count) next = UINT32_MAX;
    for (int64_t i = wanted + 1; i < count; i++) {
        if (scratch[i] < next) next = scratch[i];
        if (scratch[i] > most) most = scratch[i];
    }
    const float below = float_of((int32_t)scratch[wanted]), above = float_of((int32_t)next);
    if (most > 0x7f800000u) return float_of((int32_t)most); /* NaN where there is one */
    return below + (float)(rank - (double)wanted) * (above - below);
}

/* x with A x = b by elimination with pivots, in place of b; not finite where A is singular. */
static void solve(double *A, double *b, int size) {
    for (int k = 0; k < size; k++) {
        int pivot = k;
        for (int i = k + 1; i < size; i++)
            if (fabs(A[i * size + k]) > fabs(A[pivot * size + k])) pivot = i;
        for (int j = 0; j < size && pivot != k; j++) {
            const double held = A[k * size + j];
            A[k * size + j] = A[pivot * size + j];
            A[pivot * size + j] = held;
        }
        const double held = b[k];
        b[k] = b[pivot];
        b[pivot] = held;
        for (int i = k + 1; i < size; i++) {
            const double factor = A[i * size + k] / A[k * size + k];
            for (int j = k; j < size; j++) A[i * size + j] -= factor * A[k * size + j];
            b[i] -= factor * b[k];
        }
    }
    for (int k = size - 1; k >= 0; k--) {
        for (int j = k + 1; j < size; j++) b[k] -= A[k * size + j] * b[j];
        b[k] /= A[k * size + k];
    }
}

/* The step (omega, dt, log scale, offset) of damped normal equations H, b. */
static void step_of(const regnf_settings *set, const double *H, const double *b, int size, double damping, double scale,
                    double *step) {
    double A[64], held[64], largest = H[0], longest = 0.0;
    for (int k = 1; k < size; k++) largest = H[k * size + k] > largest ? H[k * size + k] : largest;
    memcpy(A, H, sizeof(double) * (size_t)(size * size));
    for (int k = 0; k < size; k++) {
        A[k * size + k] += damping * H[k * size + k] + set->min_damping + set->relative_damping * largest;
        if (k == 7 && set->max_offset == 0.0) A[k * size + k] += set->fixed_damping;
        step[k] = -b[k];
    }
    memcpy(held, A, sizeof held);
    solve(A, step, size);
    double growth = step[6];
    if (set->keeps_scale) {
        growth = 0.0;
    } else if (set->low > 0.0 || set->high < INFINITY) {
        const double least = log(set->low / scale), most = log(set->high / scale);
        growth = growth < least ? least : growth;
        growth = growth > most ? most : growth;
    }
    if (growth != step[6]) { /* the scale goes up to its bound, and the others follow */
        for (int k = 0; k < size; k++) step[k] = -b[k], held[6 * size + k] = 0.0;
        held[6 * size + 6] = 1.0;
        step[6] = growth;
        solve(held, step, size);
    }
    for (int k = 0; k < size; k++) longest = fabs(step[k]) > longest ? fabs(step[k]) : longest;
    const double limit = longest > set->max_step ? set->max_step / longest : 1.0;
    for (int k = 0; k < size; k++) step[k] *= limit;
}

/* out = exp(omega) R. */
static void turned_by(const double *omega, const double *R, double *out) {
    const double squares = omega[0] * omega[0] + omega[1] * omega[1] + omega[2] * omega[2], angle = sqrt(squares);
    const double half = angle < 1e-4 ? 0.5 - squares / 48.0 : sin(angle / 2.0) / angle;
    const double x = half * omega[0], y = half * omega[1], z = half * omega[2], w = cos(angle / 2.0);
    const double E[9] = {
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w),       2.0 * (x * z + y * w),
        2.0 * (x * y + z * w),       1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w),
        2.0 * (x * z - y * w),       2.0 * (y * z + x * w),       1.0 - 2.0 * (x * x + y * y),
    };
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) out[3 * i + j] = E[3 * i] * R[j] + E[3 * i + 1] * R[3 + j] + E[3 * i + 2] * R[6 + j];
}

/* All that a minimization works with: the poses that are tried, two rows for each pose, and numbers of each pose. */
typedef struct {
    const regnf_pair *pair;
    const regnf_settings *set;
    const regnf_history *history;
    regnf_poses *T, tried;
    regnf_rows rows;
    kernel l;
    int64_t taken; /* steps; -1: the first residuals are still to come */
    double *start, *damping, *cost;
    float *observed, *widths;
    int64_t *now, *next; /* rows of the present and of the tried pose */
    uint32_t *scratch;
    char *memory;
} workplace;

static char *room_for(char **at, size_t bytes) {
    char *const from = *at;
    *at += (bytes + 63) / 64 * 64;
    return from;
}

static void *begin(const regnf_pair *pair, regnf_poses *T, const regnf_settings *set, const regnf_history *history) {
    const int with_steps = set->iterations > 0;
    const size_t poses = (size_t)T->count, rows = poses * (with_steps ? 2 : 1);
    const size_t total = (size_t)(pair->scene_samples.count + pair->object_samples.count);
    const size_t numbers = 17 * poses * sizeof(double) + 2 * poses * sizeof(int64_t) + 2 * poses * sizeof(float);
    const size_t bytes = rows * total * ((with_steps ? 9 : 2) * sizeof(float) + 1) + numbers + 4 * total + 64 * 17;
    workplace *w = calloc(1, sizeof *w);
    char *at = aligned_alloc(64, (bytes + 63) / 64 * 64);
    if (w == NULL || at == NULL) {
        free(w);
        free(at);
        return NULL;
    }
    *w = (workplace){.pair = pair, .set = set, .history = history, .T = T, .taken = -1, .memory = at};
    w->l = (kernel){.total = (int64_t)total, .scene_count = pair->scene_samples.count, .normals = set->normals};
    w->l.min_cosine = pair->min_cosine;
    w->l.narrow = (float)set->unobserved_width;
    w->tried.count = T->count;
    w->tried.scale = (double *)room_for(&at, poses * sizeof(double));
    w->tried.rotation = (double *)room_for(&at, 9 * poses * sizeof(double));
    w->tried.translation = (double *)room_for(&at, 3 * poses * sizeof(double));
    double *const offset = (double *)room_for(&at, poses * sizeof(double));
    w->tried.offset = T->offset ? offset : NULL;
    w->start = (double *)room_for(&at, poses * sizeof(double));
    w->damping = (double *)room_for(&at, poses * sizeof(double));
    w->cost = (double *)room_for(&at, poses * sizeof(double));
    w->observed = (float *)room_for(&at, poses * sizeof(float));
    w->widths = (float *)room_for(&at, poses * sizeof(float));
    w->now = (int64_t *)room_for(&at, poses * sizeof(int64_t));
    w->next = (int64_t *)room_for(&at, poses * sizeof(int64_t));
    w->scratch = (uint32_t *)room_for(&at, 4 * total);
    w->rows.values = (float *)room_for(&at, rows * total * sizeof(float));
    w->rows.cosines = (float *)room_for(&at, rows * total * sizeof(float));
    if (with_steps) w->rows.jacobian = (float *)room_for(&at, 7 * rows * total * sizeof(float));
    if (pair->seen) w->rows.unobserved = (uint8_t *)room_for(&at, rows * total);
    for (int64_t h = 0; h < T->count; h++) w->now[h] = h, w->next[h] = T->count + h;
    return w;
}

static void end(void *state) {
    free(((workplace *)state)->memory);
    free(state);
}

static void next_places(const void *state, int of_object, float *out) {
    const workplace *w = state;
    places(w->pair, w->taken < 0 ? w->T : &w->tried, of_object, out);
}

static int next_fill(void *state, int of_object, const float *value, const float *gradient) {
    workplace *w = state;
    const int first = w->taken < 0;
    return fill_rows(w->pair, first ? w->T : &w->tried, of_object, &w->rows, first ? w->now : w->next, value, gradient);
}

static void keep(const regnf_history *history, const regnf_poses *T, int64_t h, int64_t at, double cost, const kernel *l,
                 const row *r) {
    if (history == NULL) return;
    history->scale[at] = T->scale[h];
    memcpy(history->rotation + 9 * at, T->rotation + 9 * h, 9 * sizeof(double));
    memcpy(history->translation + 3 * at, T->translation + 3 * h, 3 * sizeof(double));
    history->costs[at] = (float)cost;
    mean_sizes(l, r, history->of_scene + at, history->of_object + at);
}

INLINE double prior(const regnf_settings *set, const regnf_poses *T, int64_t h, float width) {
    if (T->offset == NULL) return 0.0;
    const double part = T->offset[h] / (double)width;
    return 0.5 * set->offset_prior * part * part;
}

/* A pose's next try and its present cost, by the kernel `l`, whose width is set. */
static void try_pose(const regnf_settings *set, const regnf_poses *T, int64_t h, const kernel *l, const row *now,
                     workplace *w) {
    double H[64], b[8], step[8];
    const int size = T->offset ? 8 : 7;
    normal_equations(l, now, size, H, b);
    if (T->offset) {
        H[63] += set->offset_prior;
        b[7] += set->offset_prior * T->offset[h];
    }
    step_of(set, H, b, size, w->damping[h], T->scale[h], step);
    turned_by(step, T->rotation + 9 * h, w->tried.rotation + 9 * h);
    for (int k = 0; k < 3; k++) w->tried.translation[3 * h + k] = T->translation[3 * h + k] + step[3 + k];
    w->tried.scale[h] = T->scale[h] * exp(step[6]);
    if (T->offset) {
        const double next = T->offset[h] + step[7], most = set->max_offset;
        w->tried.offset[h] = next < -most ? -most : next > most ? most : next;
    }
    w->cost[h] = cost_of(l, now, 0.0f) + prior(set, T, h, l->width);
}

static void accept_pose(regnf_poses *T, const regnf_poses *from, int64_t h) {
    T->scale[h] = from->scale[h];
    memcpy(T->rotation + 9 * h, from->rotation + 9 * h, 9 * sizeof(double));
    memcpy(T->translation + 3 * h, from->translation + 3 * h, 3 * sizeof(double));
    if (T->offset) T->offset[h] = from->offset[h];
}

/* The next poses, from the present ones. */
static void step(void *state) {
    workplace *w = state;
    const regnf_settings *set = w->set;
    const double lowest = set->widths[w->taken], widest = set->widest > lowest ? set->widest : lowest;
    for (int64_t h = 0; h < w->T->count; h++) {
        const row now = row_of(&w->rows, w->now[h], w->l.total);
        float width = (float)lowest * (float)(w->T->scale[h] / w->start[h]);
        if (set->widest > 0.0) {
            const float most = (float)(widest / lowest) * width;
            const float own = (float)set->spread_factor
                              * quantile_of_sizes(now.values, w->l.total, set->spread_quantile, w->scratch);
            width = own < width ? width : own > most ? most : own;
        }
        w->l.width = w->widths[h] = width;
        w->l.observed = w->observed[h];
        try_pose(set, w->T, h, &w->l, &now, w);
    }
    w->taken++;
}

static void settle_first(workplace *w) {
    for (int64_t h = 0; h < w->T->count; h++) {
        const row now = row_of(&w->rows, w->now[h], w->l.total);
        w->observed[h] = observed_weight(&w->l, &now, (float)w->set->min_observed_share);
        w->start[h] = w->T->scale[h];
        w->damping[h] = w->set->damping_start;
    }
    w->taken = 0;
}

static void settle(void *state) {
    workplace *w = state;
    const regnf_settings *set = w->set;
    if (w->taken < 0) {
        settle_first(w);
        return;
    }
    for (int64_t h = 0; h < w->T->count; h++) {
        row now = row_of(&w->rows, w->next[h], w->l.total);
        /* A kernel is as wide in the scene as before the step: in object units it grows with the pose's scale. */
        w->l.width = w->widths[h] * (float)(w->tried.scale[h] / w->T->scale[h]);
        w->l.observed = w->observed[h];
        const double tried = cost_of(&w->l, &now, 0.0f) + prior(set, &w->tried, h, w->l.width);
        const int better = tried < w->cost[h]; /* 0 for a step that is not finite: it is undone as well */
        if (better) {
            accept_pose(w->T, &w->tried, h);
            const int64_t held = w->now[h];
            w->now[h] = w->next[h];
            w->next[h] = held;
            w->cost[h] = tried;
        }
        double damping = better ? w->damping[h] / set->damping_decrease : w->damping[h] * set->damping_increase;
        damping = damping < set->damping_low ? set->damping_low : damping;
        w->damping[h] = damping > set->damping_high ? set->damping_high : damping;
        now = row_of(&w->rows, w->now[h], w->l.total);
        keep(w->history, w->T, h, h * set->iterations + w->taken - 1, w->cost[h], &w->l, &now);
    }
}

static void score(const void *state, float *scores, float *sizes) {
    const workplace *w = state;
    kernel l = w->l;
    l.normals = 1;
    l.narrow = l.observed = 1.0f;
    l.width = (float)w->set->score_width;
    for (int64_t h = 0; h < w->T->count; h++) {
        const row now = row_of(&w->rows, w->now[h], l.total);
        scores[h] = (float)cost_of(&l, &now, (float)w->set->unobserved_loss);
        for (int64_t i = 0; i < l.total; i++) sizes[h * l.total + i] = fabsf(now.values[i]);
    }
}

#endif
