/* A hierarchy of boxes over a mesh's triangles, eight children to a node, and of each child how its triangles look from
 * far away: what their winding number is there.
 *
 * The winding number of a surface at q is the integral of n . (x - q) / |x - q|^3 over it, over 4 pi. With x = p + d it is
 * a Taylor series in d about a middle p; here up to the second order, as Barill et al. 2018 do for soups of triangles.
 * The derivatives of 1 / |x - q| are symmetric and have no trace, so that 3, 5 and 7 numbers are enough for the orders. */
#ifndef REGNF_MESH_TREE_H
#define REGNF_MESH_TREE_H

#include <math.h>
#include <stdlib.h>

#include "triangles.h"

#define BOX_MARGIN 3e-7f /* of boxes in float32, for rounding; coordinates are within -1 and 1 */

/* Lengths are of the radius about the middle, areas of its square. Of children that there are not, boxes are infinite. */
typedef struct {
    float low[3][SLOTS], high[3][SLOTS], middle[3][SLOTS], per_radius[SLOTS];
    float flux[3][SLOTS], squares[5][SLOTS], cubes[7][SLOTS];
    int32_t child[SLOTS]; /* a node's number, or ~ a leaf's */
} mesh_node;

_Static_assert(sizeof(mesh_node) == 26 * SLOTS * 4, "as in regnf_core/native/mesh_tree.py");

typedef struct {
    float middle[3];
    int32_t number;
} placed_triangle;

/* Puts the triangles of [begin, end) with the smallest coordinates first, up to `middle`. (Hoare's selection) */
static void part_along(placed_triangle *all, int64_t begin, int64_t end, int64_t middle, int axis) {
    while (end - begin > 1) {
        const float pivot = all[begin + (end - begin) / 2].middle[axis];
        int64_t i = begin, j = end - 1;
        while (i <= j) {
            while (all[i].middle[axis] < pivot) i++;
            while (all[j].middle[axis] > pivot) j--;
            if (i > j) break;
            const placed_triangle moved = all[i];
            all[i++] = all[j];
            all[j--] = moved;
        }
        if (middle <= j) end = j + 1;
        else if (middle >= i) begin = i;
        else return;
    }
}

static int widest_axis(const placed_triangle *all, int64_t begin, int64_t end) {
    float width[3];
    for (int k = 0; k < 3; k++) {
        float low = INFINITY, high = -INFINITY;
        for (int64_t i = begin; i < end; i++) {
            const float x = all[i].middle[k];
            low = x < low ? x : low;
            high = x > high ? x : high;
        }
        width[k] = high - low;
    }
    const int second = width[1] > width[0];
    return width[2] > width[second] ? 2 : second;
}

static int64_t leaves_of(int64_t triangles) { return (triangles + SLOTS - 1) / SLOTS; }

/* Parts [begin, end) three times in two. All leaves but the mesh's last are full. cuts: (SLOTS + 1), where the children
 * begin and end · all NULL: the triangles stay. Returns the number of children. */
static int children_of(placed_triangle *all, int64_t begin, int64_t end, int64_t *cuts) {
    int count = 1;
    cuts[0] = begin, cuts[1] = end;
    for (int round = 0; round < 3; round++) {
        int64_t parts[SLOTS + 1];
        int made = 0;
        for (int i = 0; i < count; i++) {
            const int64_t from = cuts[i], to = cuts[i + 1], middle = from + (leaves_of(to - from) + 1) / 2 * SLOTS;
            parts[made++] = from;
            if (to - from <= SLOTS) continue;
            if (all != NULL) part_along(all, from, to, middle, widest_axis(all, from, to));
            parts[made++] = middle;
        }
        for (int i = 0; i < made; i++) cuts[i] = parts[i];
        cuts[count = made] = end;
    }
    return count;
}

static int64_t mesh_nodes(int64_t triangles) {
    int64_t cuts[SLOTS + 1], nodes = 1;
    const int count = children_of(NULL, 0, triangles, cuts);
    for (int i = 0; i < count; i++)
        if (cuts[i + 1] - cuts[i] > SLOTS) nodes += mesh_nodes(cuts[i + 1] - cuts[i]);
    return nodes;
}

static void fill_leaf(const regnf_mesh *mesh, const placed_triangle *all, int64_t begin, int64_t end) {
    triangles *leaf = (triangles *)mesh->leaves + begin / SLOTS;
    for (int64_t j = 0; j < SLOTS; j++) {
        const int there = begin + j < end;
        const int32_t number = all[there ? begin + j : end - 1].number;
        mesh->order[begin + j] = number;
        for (int i = 0; i < 3; i++)
            for (int k = 0; k < 3; k++)
                leaf->corners[i][k][j] = mesh->vertices[3 * mesh->faces[3 * (int64_t)number + (there ? i : 0)] + k];
    }
}

/* What is summed of triangles: a is the normal times the area, d from the middle to their places. */
typedef struct {
    double low[3], high[3], area, weighted[3];
    double radius, flux[3], squares[5], cubes[7];
} outline;

static void add_extent(const triangles *t, int j, outline *sum) {
    double first[3], second[3], normal[3];
    for (int k = 0; k < 3; k++) {
        const double *x = &t->corners[0][k][j];
        for (int i = 0; i < 3; i++) {
            const double at = x[3 * SLOTS * i];
            sum->low[k] = at < sum->low[k] ? at : sum->low[k];
            sum->high[k] = at > sum->high[k] ? at : sum->high[k];
        }
        first[k] = x[3 * SLOTS] - x[0];
        second[k] = x[6 * SLOTS] - x[0];
    }
    cross(first, second, normal);
    const double area = 0.5 * sqrt(dot(normal, normal));
    sum->area += area;
    for (int k = 0; k < 3; k++)
        sum->weighted[k] += area * (t->corners[0][k][j] + t->corners[1][k][j] + t->corners[2][k][j]) / 3.0;
}

/* The integrals over a triangle of a, of a d^T, and of a d d^T contracted with three times the same vector u; of the
 * last two what is left when their traces are taken off, by its coefficients in u. */
static void add_moments(const triangles *t, int j, const float *middle, outline *sum) {
    double d[3][3], first[3], second[3], a[3], c[3], S[3][3];
    for (int i = 0; i < 3; i++) {
        for (int k = 0; k < 3; k++) d[i][k] = t->corners[i][k][j] - (double)middle[k];
        const double squares = dot(d[i], d[i]);
        sum->radius = squares > sum->radius ? squares : sum->radius;
    }
    for (int k = 0; k < 3; k++) {
        first[k] = d[1][k] - d[0][k];
        second[k] = d[2][k] - d[0][k];
        c[k] = (d[0][k] + d[1][k] + d[2][k]) / 3.0;
    }
    cross(first, second, a);
    for (int k = 0; k < 3; k++) sum->flux[k] += a[k] *= 0.5;
    const double trace = dot(a, c) / 3.0;
    sum->squares[0] += a[0] * c[0] - trace;
    sum->squares[1] += a[1] * c[1] - trace;
    sum->squares[2] += a[0] * c[1] + a[1] * c[0];
    sum->squares[3] += a[0] * c[2] + a[2] * c[0];
    sum->squares[4] += a[1] * c[2] + a[2] * c[1];
    for (int k = 0; k < 3; k++)
        for (int l = 0; l < 3; l++)
            S[k][l] = (d[0][k] * d[0][l] + d[1][k] * d[1][l] + d[2][k] * d[2][l] + 9.0 * c[k] * c[l]) / 12.0;
    double of_trace[3];
    for (int k = 0; k < 3; k++) of_trace[k] = ((S[0][0] + S[1][1] + S[2][2]) * a[k] + 2.0 * dot(S[k], a)) / 5.0;
    for (int k = 0; k < 3; k++) { /* u_k u_i^2, then u_k u_j^2 */
        const int i = (k + 1) % 3, l = (k + 2) % 3;
        sum->cubes[2 * k] += a[k] * S[i][i] + 2.0 * a[i] * S[k][i] - of_trace[k];
        sum->cubes[2 * k + 1] += a[k] * S[l][l] + 2.0 * a[l] * S[k][l] - of_trace[k];
    }
    sum->cubes[6] += 2.0 * (a[0] * S[1][2] + a[1] * S[0][2] + a[2] * S[0][1]);
}

static void describe(const regnf_mesh *mesh, int64_t begin, int64_t end, mesh_node *node, int slot) {
    const triangles *leaves = (const triangles *)mesh->leaves;
    outline sum = {.low = {INFINITY, INFINITY, INFINITY}, .high = {-INFINITY, -INFINITY, -INFINITY}};
    float middle[3];
    for (int64_t i = begin; i < end; i++) add_extent(leaves + i / SLOTS, (int)(i % SLOTS), &sum);
    for (int k = 0; k < 3; k++) {
        middle[k] = (float)(sum.area > 0.0 ? sum.weighted[k] / sum.area : 0.5 * (sum.low[k] + sum.high[k]));
        node->middle[k][slot] = middle[k];
        node->low[k][slot] = (float)sum.low[k] - BOX_MARGIN;
        node->high[k][slot] = (float)sum.high[k] + BOX_MARGIN;
    }
    for (int64_t i = begin; i < end; i++) add_moments(leaves + i / SLOTS, (int)(i % SLOTS), middle, &sum);
    const double per_radius = sum.radius > 1e-24 ? 1.0 / sqrt(sum.radius) : 0.0; /* 0: it is never far away */
    const double area = per_radius * per_radius;
    node->per_radius[slot] = (float)per_radius;
    for (int k = 0; k < 3; k++) node->flux[k][slot] = (float)(area * sum.flux[k]);
    for (int k = 0; k < 5; k++) node->squares[k][slot] = (float)(3.0 * area * per_radius * sum.squares[k]);
    for (int k = 0; k < 7; k++) node->cubes[k][slot] = (float)(7.5 * area * area * sum.cubes[k]);
}

static int32_t grow_node(const regnf_mesh *mesh, placed_triangle *all, int64_t begin, int64_t end, int32_t *used) {
    const int32_t self = (*used)++;
    mesh_node *node = (mesh_node *)mesh->nodes + self;
    int64_t cuts[SLOTS + 1];
    const int count = children_of(all, begin, end, cuts);
    *node = (mesh_node){0};
    for (int slot = 0; slot < SLOTS; slot++) {
        if (slot >= count) {
            for (int k = 0; k < 3; k++) node->low[k][slot] = INFINITY, node->high[k][slot] = -INFINITY;
            continue;
        }
        const int64_t from = cuts[slot], to = cuts[slot + 1];
        if (to - from <= SLOTS) {
            fill_leaf(mesh, all, from, to);
            node->child[slot] = ~(int32_t)(from / SLOTS);
        } else {
            node->child[slot] = grow_node(mesh, all, from, to, used);
        }
        describe(mesh, from, to, node, slot);
    }
    return self;
}

/* Fills the mesh's nodes, leaves and order. Returns a fault. */
static int grow_mesh(const regnf_mesh *mesh) {
    placed_triangle *all = malloc((size_t)mesh->triangles * sizeof(placed_triangle));
    int32_t used = 0;
    if (all == NULL) return REGNF_NO_MEMORY;
    for (int64_t f = 0; f < mesh->triangles; f++) {
        all[f].number = (int32_t)f;
        for (int k = 0; k < 3; k++) {
            double sum = 0.0;
            for (int i = 0; i < 3; i++) sum += mesh->vertices[3 * mesh->faces[3 * f + i] + k];
            all[f].middle[k] = (float)sum;
        }
    }
    grow_node(mesh, all, 0, mesh->triangles, &used);
    free(all);
    return REGNF_DONE;
}

#endif
