/* The nearest of a set of points to each of many places: a k-d tree of boxes (Friedman, Bentley and Finkel 1977). What
 * was nearest to the place before bounds the search: neighboring places have the same points near them. */
#ifndef REGNF_NEAR_H
#define REGNF_NEAR_H

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "block.h"

#define LEAF 8
#define MOST_NEAR 64 /* points asked for at each place */

typedef struct {
    double low[3], high[3];
    int64_t begin, right;  /* begin: of a leaf in the order · right: 0 in a leaf, else the second child; the first is
                              the next node */
    double points[3][LEAF]; /* of a leaf, by axis; infinite where there are fewer */
} box_node;

typedef struct {
    const double *points;
    int64_t *order, used;
    box_node *nodes;
} box_tree;

/* Puts the points of [begin, end) with the smallest coordinates first, `middle` of them. (Hoare's selection) */
static void divide(const double *points, int64_t *order, int64_t begin, int64_t end, int64_t middle, int axis) {
    while (end - begin > 1) {
        const double pivot = points[3 * order[begin + (end - begin) / 2] + axis];
        int64_t i = begin, j = end - 1;
        while (i <= j) {
            while (points[3 * order[i] + axis] < pivot) i++;
            while (points[3 * order[j] + axis] > pivot) j--;
            if (i > j) break;
            const int64_t moved = order[i];
            order[i++] = order[j];
            order[j--] = moved;
        }
        if (middle <= j) end = j + 1;
        else if (middle >= i) begin = i;
        else return;
    }
}

static int64_t grow(box_tree *tree, int64_t begin, int64_t end) {
    const int64_t self = tree->used++;
    box_node *node = tree->nodes + self;
    node->begin = begin, node->right = 0;
    int widest = 0;
    for (int k = 0; k < 3; k++) {
        node->low[k] = INFINITY, node->high[k] = -INFINITY;
        for (int64_t i = begin; i < end; i++) {
            const double x = tree->points[3 * tree->order[i] + k];
            if (x < node->low[k]) node->low[k] = x;
            if (x > node->high[k]) node->high[k] = x;
        }
        if (node->high[k] - node->low[k] > node->high[widest] - node->low[widest]) widest = k;
    }
    if (end - begin <= LEAF) {
        for (int k = 0; k < 3; k++)
            for (int64_t i = 0; i < LEAF; i++)
                node->points[k][i] = begin + i < end ? tree->points[3 * tree->order[begin + i] + k] : INFINITY;
        return self;
    }
    const int64_t middle = begin + (end - begin) / 2;
    divide(tree->points, tree->order, begin, end, middle, widest);
    grow(tree, begin, middle);
    tree->nodes[self].right = grow(tree, middle, end);
    return self;
}

typedef struct {
    double limit, squares[MOST_NEAR];
    int64_t count, found, numbers[MOST_NEAR];
} nearest_points;

static double squared(const double *a, const double *b) {
    const double x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2];
    return x * x + y * y + z * z;
}

static double to_box(const box_node *node, const double *place) {
    double sum = 0.0;
    for (int k = 0; k < 3; k++) {
        const double under = node->low[k] - place[k], above = place[k] - node->high[k];
        const double out = under > 0.0 ? under : above > 0.0 ? above : 0.0;
        sum += out * out;
    }
    return sum;
}

static void search(const box_tree *tree, int64_t number, const double *place, nearest_points *near) {
    const box_node *node = tree->nodes + number;
    if (node->right != 0) {
        int64_t first = number + 1, second = node->right;
        double nearer = to_box(tree->nodes + first, place), farther = to_box(tree->nodes + second, place);
        if (farther < nearer) {
            const double kept = nearer;
            nearer = farther, farther = kept;
            first = node->right, second = number + 1;
        }
        if (nearer <= near->limit) search(tree, first, place, near);
        if (farther <= near->limit) search(tree, second, place, near);
        return;
    }
    double apart_of[LEAF];
    for (int i = 0; i < LEAF; i++) {
        const double x = node->points[0][i] - place[0], y = node->points[1][i] - place[1], z = node->points[2][i] - place[2];
        apart_of[i] = x * x + y * y + z * z;
    }
    for (int i = 0; i < LEAF; i++) {
        const double apart = apart_of[i];
        if (apart == INFINITY || apart > near->limit || (near->found == near->count && apart >= near->limit)) continue;
        const int64_t point = tree->order[node->begin + i];
        int64_t at = near->found < near->count ? near->found++ : near->count - 1;
        for (; at > 0 && near->squares[at - 1] > apart; at--) {
            near->squares[at] = near->squares[at - 1];
            near->numbers[at] = near->numbers[at - 1];
        }
        near->squares[at] = apart;
        near->numbers[at] = point;
        if (near->found == near->count) near->limit = near->squares[near->count - 1];
    }
}

/* Distances (m, count) and numbers (m, count) of the nearest of points (n, 3) to places (m, 3), nearest first; count is
 * at most n and MOST_NEAR, and all coordinates are finite. Returns 0, or 1 when there is no memory. */
static int nearest(const double *points, int64_t n, const double *places, int64_t m, int64_t count, double *distance,
                   int64_t *number) {
    box_tree tree = {points, malloc((size_t)n * sizeof(int64_t)), 0, malloc((size_t)(2 * n) * sizeof(box_node))};
    if (tree.order == NULL || tree.nodes == NULL) {
        free(tree.order);
        free(tree.nodes);
        return 1;
    }
    for (int64_t i = 0; i < n; i++) tree.order[i] = i;
    grow(&tree, 0, n);
    nearest_points near = {.count = count};
    for (int64_t q = 0; q < m; q++) {
        const double *place = places + 3 * q;
        near.limit = q == 0 ? INFINITY : 0.0;
        for (int64_t k = 0; k < count && q > 0; k++) {
            const double apart = squared(points + 3 * near.numbers[k], place);
            if (apart > near.limit) near.limit = apart;
        }
        near.limit *= 1.0 + 1e-12; /* for rounding, so that the same points are found again */
        near.found = 0;
        search(&tree, 0, place, &near);
        for (int64_t k = 0; k < count; k++) {
            distance[q * count + k] = sqrt(near.squares[k]);
            number[q * count + k] = near.numbers[k];
        }
    }
    free(tree.order);
    free(tree.nodes);
    return 0;
}

/* The nearest point to the center of each cell of a cubic grid. Of a block of cells only points count that are not
 * farther from its centers' box than some point is from all of it; the eight parts of a block look among these alone. */
#define LANES 8

typedef double lanes __attribute__((vector_size(8 * LANES), may_alias, aligned(8)));
typedef int64_t flags __attribute__((vector_size(8 * LANES)));

/* b where the flag is set, else a. */
INLINE lanes chosen(flags flag, lanes b, lanes a) { return (lanes)((flag & (flags)b) | (~flag & (flags)a)); }

/* Points by axis, with their numbers, and infinite ones up to a multiple of LANES. */
typedef struct {
    int64_t count;
    double *axes[3], *numbers;
} some_points;

typedef struct {
    double low[3], edge[3], *distance;
    int64_t cells, *number;
} cell_centers;

static some_points points_at(double *memory, int64_t room) {
    return (some_points){0, {memory, memory + room, memory + 2 * room}, memory + 3 * room};
}

static void pad(some_points *p) {
    for (int64_t i = p->count; i % LANES != 0; i++)
        for (int k = 0; k < 3; k++) p->axes[k][i] = INFINITY;
}

/* Of `all` those that may be the nearest of a place between two corners. from: room for all. */
static void leave(const some_points *all, const double *low, const double *high, double *from, some_points *left) {
    lanes least = (lanes){0} + INFINITY;
    double limit = INFINITY;
    for (int64_t i = 0; i < all->count; i += LANES) {
        lanes apart = {0}, farthest = {0};
        for (int k = 0; k < 3; k++) {
            const lanes x = *(const lanes *)(all->axes[k] + i), under = low[k] - x, above = x - high[k];
            const lanes out = chosen(under < above, above, under), most = chosen(under < above, under, above);
            apart += chosen(out > 0.0, out * out, (lanes){0});
            farthest += most * most;
        }
        *(lanes *)(from + i) = apart;
        least = chosen(farthest < least, farthest, least);
    }
    for (int j = 0; j < LANES; j++) limit = least[j] < limit ? least[j] : limit;
    limit *= 1.0 + 1e-12; /* for rounding */
    int64_t count = 0;
    for (int64_t i = 0; i < all->count; i++) {
        for (int k = 0; k < 3; k++) left->axes[k][count] = all->axes[k][i];
        left->numbers[count] = all->numbers[i];
        count += from[i] <= limit;
    }
    left->count = count;
    pad(left);
}

static void nearest_to(const some_points *p, const double *place, double *distance, int64_t *number) {
    lanes least = (lanes){0} + INFINITY, best = {0};
    for (int64_t i = 0; i < p->count; i += LANES) {
        lanes apart = {0};
        for (int k = 0; k < 3; k++) {
            const lanes along = *(const lanes *)(p->axes[k] + i) - place[k];
            apart += along * along;
        }
        const flags nearer = apart < least;
        best = chosen(nearer, *(const lanes *)(p->numbers + i), best);
        least = chosen(nearer, apart, least);
    }
    int lane = 0;
    for (int j = 1; j < LANES; j++)
        if (least[j] < least[lane]) lane = j;
    *distance = sqrt(least[lane]);
    *number = (int64_t)best[lane];
}

/* All cells from the first up to the end. memory: 5 rooms for each level beneath. */
static void block_of_cells(const cell_centers *grid, const some_points *all, const int64_t *first, const int64_t *end,
                           double *memory, int64_t room) {
    double low[3], high[3];
    for (int k = 0; k < 3; k++) {
        low[k] = grid->low[k] + ((double)first[k] + 0.5) * grid->edge[k];
        high[k] = grid->low[k] + ((double)end[k] - 0.5) * grid->edge[k];
    }
    if (end[0] - first[0] == 1 && end[1] - first[1] == 1 && end[2] - first[2] == 1) {
        const int64_t cell = (first[0] * grid->cells + first[1]) * grid->cells + first[2];
        nearest_to(all, low, grid->distance + cell, grid->number + cell);
        return;
    }
    some_points left = points_at(memory, room);
    leave(all, low, high, memory + 4 * room, &left);
    for (int part = 0; part < 8; part++) {
        int64_t from[3], to[3];
        for (int k = 0; k < 3; k++) {
            const int64_t middle = first[k] + (end[k] - first[k] + 1) / 2;
            from[k] = part >> k & 1 ? middle : first[k];
            to[k] = part >> k & 1 ? end[k] : middle;
        }
        if (from[0] < to[0] && from[1] < to[1] && from[2] < to[2])
            block_of_cells(grid, &left, from, to, memory + 5 * room, room);
    }
}

/* Distances and numbers (cells, cells, cells) of the nearest of points (n, 3), n >= 1, to the centers of the cells; all
 * coordinates are finite. Returns a fault. */
static int nearest_to_cells(const double *points, int64_t n, const double *low, const double *edge, int64_t cells,
                            double *distance, int64_t *number) {
    const int64_t room = n + LANES;
    int levels = 1;
    while ((int64_t)1 << (levels - 1) < cells) levels++;
    double *memory = malloc((size_t)(5 * room * (levels + 1)) * sizeof(double));
    if (memory == NULL) return REGNF_NO_MEMORY;
    some_points all = points_at(memory, room);
    all.count = n;
    for (int64_t i = 0; i < n; i++) {
        for (int k = 0; k < 3; k++) all.axes[k][i] = points[3 * i + k];
        all.numbers[i] = (double)i;
    }
    pad(&all);
    cell_centers grid = {.distance = distance, .cells = cells, .number = number};
    memcpy(grid.low, low, sizeof grid.low);
    memcpy(grid.edge, edge, sizeof grid.edge);
    const int64_t first[3] = {0, 0, 0}, end[3] = {cells, cells, cells};
    block_of_cells(&grid, &all, first, end, memory + 5 * room, room);
    free(memory);
    return REGNF_DONE;
}

#endif
