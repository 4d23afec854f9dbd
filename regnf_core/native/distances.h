/* Distances on grids, and of a model anywhere: what regnf_core/robust/search/distance_grid.py and VoxelGridFunction of
 * regnf_core/fields/build.py say in tensor algebra. */
#ifndef REGNF_DISTANCES_H
#define REGNF_DISTANCES_H

#include <math.h>
#include <string.h>

#include "block.h"

INLINE float dot3(const float *a, const float *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

/* The place in a grid's box that is nearest to x; beyond: from there to x. Returns the squared distance. */
INLINE float into_box(const float *x, const float *low, const float *high, float *inside, float *beyond) {
    for (int k = 0; k < 3; k++) {
        inside[k] = x[k] < low[k] ? low[k] : x[k] > high[k] ? high[k] : x[k];
        beyond[k] = x[k] - inside[k];
    }
    return dot3(beyond, beyond);
}

/* The whole number below c, within 0 and last; 0 for NaN. */
INLINE int64_t cell_of(float c, int64_t last) {
    return c >= (float)last ? last : c > 0.0f ? (int64_t)c : 0;
}

static int grid_distances(const void *self, const float *points, int64_t count, float *value, float *gradient) {
    const regnf_planes *grid = self;
    const int64_t cells = grid->cells;
    for (int64_t p = 0; p < count; p++, points += 3) {
        float inside[3], beyond[3];
        int64_t cell[3];
        const float squares = into_box(points, grid->low, grid->high, inside, beyond);
        for (int k = 0; k < 3; k++) cell[k] = cell_of((inside[k] - grid->low[k]) / grid->edge[k], cells - 1);
        const float *plane = grid->planes + 4 * ((cell[0] * cells + cell[1]) * cells + cell[2]);
        const float distance = sqrtf(squares);
        value[p] = plane[0] + dot3(plane + 1, inside);
        if (squares != 0.0f) value[p] += distance;
        if (gradient == NULL) continue;
        memcpy(gradient, plane + 1, 3 * sizeof(float));
        if (squares != 0.0f)
            for (int k = 0; k < 3; k++) gradient[k] = beyond[k] / (distance < 1e-9f ? 1e-9f : distance);
        gradient += 3;
    }
    return REGNF_DONE;
}

static int voxel_distances(const void *self, const float *points, int64_t count, float *value, float *gradient) {
    const regnf_voxels *grid = self;
    const int64_t rows = grid->counts[1], columns = grid->counts[2], slab = rows * columns;
    for (int64_t p = 0; p < count; p++, points += 3) {
        float inside[3], beyond[3], w[3];
        int64_t cell[3];
        const float squares = into_box(points, grid->low, grid->high, inside, beyond);
        for (int k = 0; k < 3; k++) {
            const float position = (inside[k] - grid->low[k]) / grid->spacing[k];
            cell[k] = cell_of(position, grid->counts[k] - 2);
            w[k] = position - (float)cell[k];
        }
        const float *v = grid->values + (cell[0] * rows + cell[1]) * columns + cell[2];
        float along[4], slope[4]; /* at the ends of the four edges along z, and their differences */
        for (int edge = 0; edge < 4; edge++) {
            const float *end = v + (edge / 2) * slab + (edge % 2) * columns;
            slope[edge] = end[1] - end[0];
            along[edge] = end[0] + w[2] * slope[edge];
        }
        const float lower = along[0] + w[1] * (along[1] - along[0]), upper = along[2] + w[1] * (along[3] - along[2]);
        value[p] = lower + w[0] * (upper - lower);
        const float distance = sqrtf(squares);
        if (squares != 0.0f) value[p] += grid->outward * distance;
        if (gradient == NULL) continue;
        const float at = slope[0] + w[1] * (slope[1] - slope[0]), to = slope[2] + w[1] * (slope[3] - slope[2]);
        const float derivative[3] = {
            upper - lower,
            (along[1] - along[0]) + w[0] * ((along[3] - along[2]) - (along[1] - along[0])),
            at + w[0] * (to - at),
        };
        for (int k = 0; k < 3; k++) gradient[k] = beyond[k] == 0.0f ? derivative[k] / grid->spacing[k] : 0.0f;
        if (squares != 0.0f)
            for (int k = 0; k < 3; k++) gradient[k] += grid->outward * (beyond[k] / distance);
        gradient += 3;
    }
    return REGNF_DONE;
}

/* Distances and gradients of a model at points, which are overwritten. Returns a fault. */
static int ask_model(const regnf_model *m, float *points, int64_t count, float *value, float *gradient) {
    for (int64_t p = 0; p < count; p++) {
        const double x[3] = {points[3 * p], points[3 * p + 1], points[3 * p + 2]};
        for (int k = 0; k < 3; k++) {
            const double *row = m->turn + 3 * k;
            points[3 * p + k] = (float)(row[0] * x[0] + row[1] * x[1] + row[2] * x[2] + m->shift[k]);
        }
    }
    const int fault = m->ask(m->self, points, count, value, gradient);
    if (fault != REGNF_DONE) return fault;
    float turn[9], probe = 0.0f; /* 0, or NaN where something is not finite */
    for (int k = 0; k < 9; k++) turn[k] = (float)(m->factor * m->turn[k]);
    for (int64_t p = 0; p < count; p++, gradient += 3) {
        float g[3];
        memcpy(g, gradient, sizeof g);
        value[p] *= (float)m->factor;
        for (int k = 0; k < 3; k++) gradient[k] = turn[k] * g[0] + turn[3 + k] * g[1] + turn[6 + k] * g[2];
        probe += 0.0f * value[p] + 0.0f * gradient[0] + 0.0f * gradient[1] + 0.0f * gradient[2];
    }
    return m->checked && probe != 0.0f ? REGNF_NOT_FINITE : REGNF_DONE;
}

#endif
