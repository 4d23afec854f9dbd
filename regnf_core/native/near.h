/* The nearest of a set of points to each of many places: a k-d tree of boxes (Friedman, Bentley and Finkel 1977). What
 * was nearest to the place before bounds the search: neighboring places have the same points near them. */
#ifndef REGNF_NEAR_H
#define REGNF_NEAR_H

#include <math.h>
#include <stdlib.h>

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
        if (apart > near->limit || (near->found == near->count && apart >= near->limit)) continue;
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

#endif
