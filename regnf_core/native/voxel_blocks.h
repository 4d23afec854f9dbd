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

/* Where corner c takes its part of an axis from: 1 for the upper one. */
#define UPPER(c, axis) ((c) >> (2 - (axis)) & 1)

/* The least that the blocks nearby allow at the corners, in place of those that are in a block that the map does not
 * have: the value of a block's nearest node, and the distance to it. */
static void allowed_values(const regnf_blocks *map, const int64_t *rows, const cell_corners *at, float *values) {
    const int64_t edge = map->edge, nodes = edge * edge * edge;
    const double last = (double)(edge - 1), per_node = (double)(map->outward * map->voxel_size);
    for (int64_t i = 0; i < map->near; i++) {
        int64_t inside[3][2];
        double squares[3][2], away[8];
        float allowed[8];
        for (int k = 0; k < 3; k++) {
            const double begin = (double)(edge * map->blocks[3 * rows[i] + k]);
            for (int upper = 0; upper < 2; upper++) {
                const double local = at->node[k][upper] - begin;
                const double within = local < 0.0 ? 0.0 : local > last ? last : local;
                inside[k][upper] = (int64_t)within;
                squares[k][upper] = (local - within) * (local - within);
            }
        }
        for (int c = 0; c < 8; c++)
            away[c] = squares[0][UPPER(c, 0)] + squares[1][UPPER(c, 1)] + squares[2][UPPER(c, 2)];
        for (int c = 0; c < 8; c++) away[c] = sqrt(away[c]);
        for (int c = 0; c < 8; c++) {
            const int64_t row = inside[0][UPPER(c, 0)] * edge + inside[1][UPPER(c, 1)];
            allowed[c] = node_value(map, rows[i] * nodes + row * edge + inside[2][UPPER(c, 2)]);
        }
        for (int c = 0; c < 8; c++) allowed[c] = (float)(allowed[c] + per_node * away[c]);
        for (int c = 0; c < 8; c++) {
            const int less = map->outward * allowed[c] < map->outward * values[c];
            values[c] = (i == 0) | less | (allowed[c] != allowed[c]) ? allowed[c] : values[c]; /* NaN stays */
        }
    }
}

/* The values at a cell's eight corners that one block says: those of corner `of` and of all that lie in its block. */
INLINE void values_of_block(const regnf_blocks *map, const cell_corners *at, int of, float *values) {
    const int64_t edge = map->edge;
    const double block[3] = {at->block[0][UPPER(of, 0)], at->block[1][UPPER(of, 1)], at->block[2][UPPER(of, 2)]};
    const int64_t row = row_of_block(map, block);
    if (row < 0) {
        allowed_values(map, rows_near(map, block), at, values);
        return;
    }
    int64_t along[3][2]; /* of a corner in another block, that of some node here */
    for (int k = 0; k < 3; k++)
        for (int upper = 0; upper < 2; upper++) along[k][upper] = (int64_t)at->local[k][upper];
    for (int c = 0; c < 8; c++) {
        const int64_t slab = row * edge + along[0][UPPER(c, 0)], line = slab * edge + along[1][UPPER(c, 1)];
        values[c] = node_value(map, line * edge + along[2][UPPER(c, 2)]);
    }
}

/* The values at a cell's eight corners. */
INLINE void corner_values(const regnf_blocks *map, const float *cell, float *values) {
    cell_corners at;
    corners_of(map, cell, &at);
    int parted = 0; /* the axes along which the upper corners lie in another block, as bits of a corner's number */
    for (int k = 0; k < 3; k++) parted |= (at.block[k][0] != at.block[k][1]) << (2 - k);
    values_of_block(map, &at, 0, values);
    for (int of = 1; of <= parted; of++) {
        float others[8];
        if ((of & parted) != of) continue;
        values_of_block(map, &at, of, others);
        for (int c = 0; c < 8; c++)
            if ((c & parted) == of) values[c] = others[c];
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
