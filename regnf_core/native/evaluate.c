/* Signed distance and gradient of a field at many points. Compiled once for each instruction set, whose name is
 * REGNF_SET then.
 *
 * Points are taken in blocks of BLOCK, padded where they are fewer, so that a point's result does not depend on those
 * beside it. Within a block each feature is a plane: one row of BLOCK numbers. */
#include "block.h"
#include "distances.h"
#include "steps.h"
#include "minimize.h"
#include "near.h"
#include "discs.h"
#include "gaussians.h"
#include "mesh.h"
#include "voxel_blocks.h"

#include <stdlib.h>
#include <string.h>

static int64_t widest(const regnf_field *f) {
    int64_t most = 0;
    for (int32_t i = 0; i < f->layers; i++)
        if (f->widths[i] > most) most = f->widths[i];
    return most;
}

static int64_t slope_rows(const regnf_field *f) {
    int64_t rows = 0;
    for (int32_t i = 1; i < f->layers - 1; i++) rows += f->widths[i];
    return rows;
}

/* Reads the points from `first` on; the last of them fills what is left of the block. */
static void read_points(const float *points, int64_t first, int64_t count, plane *x) {
    for (int64_t p = 0; p < BLOCK; p++) {
        const float *point = points + 3 * (first + p < count ? first + p : count - 1);
        for (int axis = 0; axis < 3; axis++) x[axis][p] = point[axis];
    }
}

static void write_gradient(float *gradient, int64_t first, int64_t live, const plane *by_point) {
    for (int64_t p = 0; p < live; p++)
        for (int axis = 0; axis < 3; axis++) gradient[3 * (first + p) + axis] = by_point[axis][p];
}

typedef struct {
    plane *inputs, *hidden, *next, *slopes, *by_input, *grid_slopes;
} scratch;

static void one_block(const regnf_field *f, const plane *x, scratch s, int want, float *distance, plane *by_point) {
    plane z[3], inner[3];
    memcpy(z, x, sizeof z);
    memcpy(inner, x, sizeof inner);
    if (f->contraction != 0) {
        contract(inner);
        if (f->contraction == 1) memcpy(z, inner, sizeof z);
    }
    const int32_t waves = 2 * f->directions * f->degree;
    memcpy(s.inputs, z, sizeof z);
    encode_waves(f, z, s.inputs + 3);
    encode_grid(f, inner, s.inputs + 3 + waves, want ? s.grid_slopes : NULL);
    plane *fed = forward(f, s.inputs, s.hidden, s.next, want ? s.slopes : NULL, distance);
    if (!want) return;
    plane *spare = fed == s.hidden ? s.next : s.hidden;
    backward(f, fed, spare, s.slopes, s.by_input);
    memcpy(by_point, s.by_input, 3 * sizeof(plane));
    pull_back_waves(f, s.inputs + 3, s.by_input + 3, by_point);
    if (f->contraction == 1) pull_back_contraction(x, by_point);
    if (f->levels == 0) return;
    plane by_grid[3];
    pull_back_grid(f, s.grid_slopes, s.by_input + 3 + waves, by_grid);
    if (f->contraction != 0) pull_back_contraction(x, by_grid);
    for (int axis = 0; axis < 3; axis++)
        for (int p = 0; p < BLOCK; p++) by_point[axis][p] += by_grid[axis][p];
}

int REGNF_EVALUATE(REGNF_SET)(const void *field, const float *points, int64_t count, float *distance, float *gradient) {
    const regnf_field *f = field;
    if (count <= 0) return REGNF_DONE;
    const int64_t wide = widest(f), inputs = f->widths[0], grid = (int64_t)f->levels * f->features;
    const int64_t rows = 2 * inputs + 2 * wide + slope_rows(f) + 3 * grid;
    plane *memory = aligned_alloc(64, (size_t)rows * sizeof(plane));
    if (memory == NULL) return REGNF_NO_MEMORY;
    scratch s = {.inputs = memory};
    s.by_input = s.inputs + inputs;
    s.hidden = s.by_input + inputs;
    s.next = s.hidden + wide;
    s.slopes = s.next + wide;
    s.grid_slopes = s.slopes + slope_rows(f);
    for (int64_t first = 0; first < count; first += BLOCK) {
        const int64_t live = count - first < BLOCK ? count - first : BLOCK;
        plane x[3], by_point[3], found;
        read_points(points, first, count, x);
        one_block(f, x, s, gradient != NULL, found, by_point);
        memcpy(distance + first, found, (size_t)live * sizeof(float));
        if (gradient != NULL) write_gradient(gradient, first, live, by_point);
    }
    free(memory);
    return REGNF_DONE;
}

void REGNF_ELEMENTARY(REGNF_SET)(int which, const float *x, int64_t count, float *out) {
    for (int64_t i = 0; i < count; i++) {
        float sine, cosine;
        if (which == 0) out[i] = exp_of(x[i]);
        if (which == 1) out[i] = log1p_of(x[i]);
        if (which < 2) continue;
        sin_cos(x[i], &sine, &cosine);
        out[i] = which == 2 ? sine : cosine;
    }
}

const regnf_steps REGNF_STEPS(REGNF_SET) = {
    places,         fill,
    begin,          next_places, next_fill, settle, step, score, end,
    grid_distances, voxel_distances,  block_distances, mesh_distances,
    block_slots,
    mesh_nodes,     grow_mesh,   mesh_at, mesh_closest, mesh_winding,
    nearest,        nearest_to_cells,
    kernel_sums,    nearest_discs,  gaussian_depths,
};
