/* The distance in a sparse map of voxel blocks: what VoxelBlocksFunction of regnf_core/fields/voxel_blocks.py says in
 * tensor algebra.
 *
 * Nodes are counted in float64: whole numbers there are exact as far as blocks may lie, and a place that is farther away
 * than any integer overflows nothing. */
#ifndef REGNF_VOXEL_BLOCKS_H
#define REGNF_VOXEL_BLOCKS_H

#include <math.h>
#include <string.h>

#include "block.h"

#define MOST_NEAR_BLOCKS 4 /* as in regnf_core/fields/voxel_blocks.py */

/* Where a block's number is looked for first. */
INLINE int64_t first_slot(int64_t number, int64_t bits) {
    return (int64_t)(((uint64_t)number * 0x9E3779B97F4A7C15u) >> (64 - bits));
}

/* The slots (1 << bits) of blocks' numbers (count) and their rows (count): more slots than blocks, so that there are
 * empty ones, and 1 <= bits < 64. A number that occurs earlier is found first. */
static void block_slots(const int64_t *numbers, const int64_t *rows, int64_t count, int64_t bits, regnf_slot *slots) {
    const int64_t mask = ((int64_t)1 << bits) - 1;
    for (int64_t i = 0; i <= mask; i++) slots[i] = (regnf_slot){-1, -1};
    for (int64_t i = 0; i < count; i++) {
        int64_t at = first_slot(numbers[i], bits);
        while (slots[at].row >= 0) at = (at + 1) & mask;
        slots[at] = (regnf_slot){numbers[i], rows[i]};
    }
}

/* The row of a block, or -1. */
INLINE int64_t row_of_block(const regnf_blocks *map, const double *block) {
    int64_t number = 0;
    for (int k = 0; k < 3; k++) {
        const double offset = block[k] - (double)map->low[k];
        if (!(offset >= 0.0 && offset < (double)map->size[k])) return -1;
        number = number * map->size[k] + (int64_t)offset;
    }
    const int64_t mask = ((int64_t)1 << map->bits) - 1;
    for (int64_t at = first_slot(number, map->bits); map->slots[at].row >= 0; at = (at + 1) & mask)
        if (map->slots[at].number == number) return map->slots[at].row;
    return -1;
}

/* The rows (map->near) of blocks near one that the map does not have. */
INLINE const int64_t *rows_near(const regnf_blocks *map, const double *block) {
    int64_t cell = 0;
    for (int k = 0; k < 3; k++) {
        const double offset = block[k] - (double)map->low[k], last = (double)(map->size[k] - 1);
        const int64_t within = offset >= last ? map->size[k] - 1 : offset > 0.0 ? (int64_t)offset : 0;
        cell = cell * ((map->size[k] + map->step - 1) / map->step) + within / map->step;
    }
    return map->table + cell * map->near;
}

INLINE float from_half(uint16_t half) {
    const uint32_t exponent = half & 0x7c00, rest = half & 0x7fff;
    uint32_t bits = (rest << 13) + (exponent == 0x7c00 ? (uint32_t)224 << 23 : (uint32_t)112 << 23);
    float found;
    memcpy(&found, &bits, sizeof found);
    if (exponent == 0) found = (float)rest * 0x1p-24f;
    return half & 0x8000 ? -found : found;
}

INLINE float node_value(const regnf_blocks *map, int64_t number) {
    if (map->half) return from_half(((const uint16_t *)map->values)[number]);
    return ((const float *)map->values)[number];
}

/* Where the eight corners of a cell are, by axis: node, block and place within the block of the lower and of the upper
 * ones. Corner c has the upper ones of x, y and z where 4, 2 and 1 are in c. */
typedef struct {
    double node[3][2], block[3][2], local[3][2];
} cell_corners;

INLINE void corners_of(const regnf_blocks *map, const float *cell, cell_corners *to) {
    const double edge = (double)map->edge;
    for (int k = 0; k < 3; k++) {
        const double node = cell[k], block = floor(node / edge), next = node - edge * block + 1.0;
        const int within = next < edge;
        to->node[k][0] = node;
        to->node[k][1] = node + 1.0;
        to->block[k][0] = block;
        to->block[k][1] = within ? block : block + 1.0;
        to->local[k][0] = next - 1.0;
        to->local[k][1] = within ? next : 0.0;
    }
}

/* The least that the blocks nearby allow at the corners `wanted` (a bit for each), which lie in one block that the map
 * does not have: the value of a block's nearest node, and the distance to it. */
static void allowed_values(const regnf_blocks *map, const int64_t *rows, const cell_corners *at, int wanted,
                           float *values) {
    const int64_t edge = map->edge;
    const double last = (double)(edge - 1), per_node = (double)(map->outward * map->voxel_size);
    for (int64_t i = 0; i < map->near; i++) {
        int64_t inside[3][2];
        double squares[3][2];
        for (int k = 0; k < 3; k++)
            for (int upper = 0; upper < 2; upper++) {
                const double local = at->node[k][upper] - (double)(edge * map->blocks[3 * rows[i] + k]);
                const double within = local < 0.0 ? 0.0 : local > last ? last : local;
                inside[k][upper] = (int64_t)within;
                squares[k][upper] = (local - within) * (local - within);
            }
        for (int c = 0; c < 8; c++) {
            const int x = c >> 2, y = c >> 1 & 1, z = c & 1;
            if (!(wanted >> c & 1)) continue;
            const int64_t number = ((rows[i] * edge + inside[0][x]) * edge + inside[1][y]) * edge + inside[2][z];
            const double away = sqrt(squares[0][x] + squares[1][y] + squares[2][z]);
            const float allowed = (float)(node_value(map, number) + per_node * away);
            const int less = map->outward * allowed < map->outward * values[c] || allowed != allowed; /* NaN stays */
            if (i == 0 || less) values[c] = allowed;
        }
    }
}

/* The values at a cell's eight corners. */
INLINE void corner_values(const regnf_blocks *map, const float *cell, float *values) {
    const int64_t edge = map->edge;
    cell_corners at;
    corners_of(map, cell, &at);
    int parted = 0; /* the axes along which the upper corners lie in another block, as bits of a corner's number */
    for (int k = 0; k < 3; k++) parted |= (at.block[k][0] != at.block[k][1]) << (2 - k);
    for (int first = 0; first < 8; first++) { /* of the corners in each block */
        if ((first & parted) != first) continue;
        const double block[3] = {at.block[0][first >> 2], at.block[1][first >> 1 & 1], at.block[2][first & 1]};
        const int64_t row = row_of_block(map, block);
        int here = 0;
        for (int c = 0; c < 8; c++) here |= ((c & parted) == first) << c;
        if (row < 0) {
            allowed_values(map, rows_near(map, block), &at, here, values);
            continue;
        }
        for (int c = 0; c < 8; c++) {
            if (!(here >> c & 1)) continue;
            const int64_t x = (int64_t)at.local[0][c >> 2], y = (int64_t)at.local[1][c >> 1 & 1];
            values[c] = node_value(map, ((row * edge + x) * edge + y) * edge + (int64_t)at.local[2][c & 1]);
        }
    }
}

/* The value between the corners, and its slope along each axis, in units of the weights. */
INLINE float interpolated(const float *corner, const float *weight, float *slope) {
    float by_x[4], face[4], by_y[2], line[2], by_x_there[2];
    for (int i = 0; i < 4; i++) {
        by_x[i] = corner[4 + i] - corner[i];
        face[i] = between(corner[i], corner[4 + i], weight[0]);
    }
    for (int i = 0; i < 2; i++) {
        by_x_there[i] = between(by_x[i], by_x[2 + i], weight[1]);
        by_y[i] = face[2 + i] - face[i];
        line[i] = between(face[i], face[2 + i], weight[1]);
    }
    slope[0] = between(by_x_there[0], by_x_there[1], weight[2]);
    slope[1] = between(by_y[0], by_y[1], weight[2]);
    slope[2] = line[1] - line[0];
    return between(line[0], line[1], weight[2]);
}

/* NaN where a point, or its place among the nodes, is not finite. */
static int block_distances(const void *self, const float *points, int64_t count, float *value, float *gradient) {
    const regnf_blocks *map = self;
    for (int64_t p = 0; p < count; p++, points += 3) {
        float cell[3], weight[3], corner[8], slope[3] = {NAN, NAN, NAN};
        value[p] = 0.0f;
        for (int k = 0; k < 3; k++) {
            const float position = (points[k] - map->origin[k]) / map->voxel_size;
            cell[k] = floorf(position);
            weight[k] = position - cell[k];
            value[p] += weight[k];
        }
        if (value[p] == value[p]) {
            corner_values(map, cell, corner);
            value[p] = interpolated(corner, weight, slope);
        }
        if (gradient == NULL) continue;
        for (int k = 0; k < 3; k++) gradient[k] = slope[k] / map->voxel_size;
        gradient += 3;
    }
    return REGNF_DONE;
}

#endif
