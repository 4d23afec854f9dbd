/* The signed distance of a triangle mesh: what regnf_core/fields/mesh.py says, by the hierarchy of mesh_tree.h. */
#ifndef REGNF_MESH_H
#define REGNF_MESH_H

#include <math.h>
#include <string.h>

#include "mesh_tree.h"

#define FAR_AWAY 1e6    /* from the middle of a mesh: places beyond look for the triangle of a place on the way there */
#define FAR_NODE 2.0f   /* radii from a node's middle, beyond which its series stands for its triangles */
#define DECIDED 0.01    /* as in regnf_core/fields/mesh.py */
#define MOST_WAITING 512 /* nodes: at most 7 for each level, and there are no more levels than halvings of 2^31 */

typedef struct {
    double squares, way[3]; /* from the place to the closest point */
    int64_t triangle;
} closest_point;

static double to_face(const regnf_mesh *mesh, int64_t triangle, const double *q, double *way) {
    double a[3][3];
    for (int i = 0; i < 3; i++) memcpy(a[i], mesh->vertices + 3 * mesh->faces[3 * triangle + i], sizeof a[i]);
    return to_triangle(q, a, way);
}

/* Squared distances to the boxes of a node's children; a little too small rather than too large. */
static void squares_to_boxes(const mesh_node *node, const float *q, float *squares) {
    for (int j = 0; j < SLOTS; j++) {
        float sum = 0.0f;
        for (int k = 0; k < 3; k++) {
            const float under = node->low[k][j] - q[k], above = q[k] - node->high[k][j];
            const float out = under > above ? under : above, beyond = out > 0.0f ? out : 0.0f;
            sum += beyond * beyond;
        }
        squares[j] = sum;
    }
}

typedef struct {
    float squares;
    int32_t number;
} waiting;

/* Puts the children that may be closer than the limit on top of those that wait, the closest one last. */
static int put_children(const mesh_node *node, const float *q, float limit, waiting *stack, int count) {
    float squares[SLOTS];
    const int first = count;
    squares_to_boxes(node, q, squares);
    for (int j = 0; j < SLOTS; j++) {
        if (!(squares[j] <= limit)) continue;
        int at = count++;
        for (; at > first && stack[at - 1].squares < squares[j]; at--) stack[at] = stack[at - 1];
        stack[at] = (waiting){squares[j], node->child[j]};
    }
    return count;
}

/* The triangle closest to a place not beyond FAR_AWAY; squares: a limit, and then its squared distance. Returns -1
 * where none is closer than the limit. */
static int64_t closest_triangle(const regnf_mesh *mesh, const double *q, double *squares) {
    const float place[3] = {(float)q[0], (float)q[1], (float)q[2]};
    waiting stack[MOST_WAITING];
    int64_t best = -1;
    int count = 1;
    stack[0] = (waiting){0.0f, 0};
    while (count > 0) {
        const waiting next = stack[--count];
        const float limit = (float)*squares * (1.0f + 2e-6f); /* for rounding of places in float32 */
        if (next.squares > limit) continue;
        if (next.number >= 0) {
            count = put_children((const mesh_node *)mesh->nodes + next.number, place, limit, stack, count);
            continue;
        }
        double found[SLOTS];
        squares_to((const triangles *)mesh->leaves + ~next.number, q, found);
        for (int j = 0; j < SLOTS; j++) {
            if (!(found[j] < *squares)) continue;
            *squares = found[j];
            best = mesh->order[SLOTS * (int64_t)~next.number + j];
        }
    }
    return best;
}

/* nearby: a triangle that bounds the search, or -1; it changes nothing else. Returns 0 where the place is not finite. */
static int closest_to(const regnf_mesh *mesh, const double *q, int64_t nearby, closest_point *found) {
    double place[3], way[3], size = 0.0;
    for (int k = 0; k < 3; k++) size = fabs(q[k]) > size ? fabs(q[k]) : size;
    if (!(fabs(q[0]) + fabs(q[1]) + fabs(q[2]) < 1e150)) return 0;
    for (int k = 0; k < 3; k++) place[k] = size > FAR_AWAY ? q[k] * (FAR_AWAY / size) : q[k];
    const double none = 1e30;
    double squares = nearby < 0 ? none : to_face(mesh, nearby, place, way) * (1.0 + 1e-12) + 1e-28;
    found->triangle = closest_triangle(mesh, place, &squares);
    if (found->triangle < 0) { /* where rounding made the limit too small */
        squares = none;
        found->triangle = closest_triangle(mesh, place, &squares);
    }
    if (found->triangle < 0) return 0;
    found->squares = to_face(mesh, found->triangle, q, found->way);
    return 1;
}

/* Winding numbers times 4 pi of a node's children far away; which of them are near. Returns the sum. */
static double far_children(const mesh_node *node, const float *q, int32_t *near) {
    float values[SLOTS], sum = 0.0f;
    for (int j = 0; j < SLOTS; j++) {
        const float x = (q[0] - node->middle[0][j]) * node->per_radius[j];
        const float y = (q[1] - node->middle[1][j]) * node->per_radius[j];
        const float z = (q[2] - node->middle[2][j]) * node->per_radius[j];
        const float xx = x * x, yy = y * y, zz = z * z, squares = xx + yy + zz, per = 1.0f / squares;
        const float flux = node->flux[0][j] * x + node->flux[1][j] * y + node->flux[2][j] * z;
        const float *const s = &node->squares[0][j], *const c = &node->cubes[0][j];
        const float second = s[0] * (xx - zz) + s[SLOTS] * (yy - zz) + s[2 * SLOTS] * (x * y) + s[3 * SLOTS] * (x * z)
                             + s[4 * SLOTS] * (y * z);
        const float third = x * (c[0] * (yy - xx / 3.0f) + c[SLOTS] * (zz - xx / 3.0f))
                            + y * (c[2 * SLOTS] * (zz - yy / 3.0f) + c[3 * SLOTS] * (xx - yy / 3.0f))
                            + z * (c[4 * SLOTS] * (xx - zz / 3.0f) + c[5 * SLOTS] * (yy - zz / 3.0f))
                            + c[6 * SLOTS] * (x * y * z);
        const int is_far = squares > FAR_NODE * FAR_NODE;
        near[j] = !is_far;
        values[j] = is_far ? -(flux + per * (second + per * third)) * per * sqrtf(per) : 0.0f;
    }
    for (int j = 0; j < SLOTS; j++) sum += values[j];
    return (double)sum;
}

static double winding_number(const regnf_mesh *mesh, const double *q) {
    const float place[3] = {(float)q[0], (float)q[1], (float)q[2]};
    int32_t stack[MOST_WAITING], near[SLOTS];
    int count = 1;
    double far = 0.0;
    angles sum;
    no_angle(&sum);
    stack[0] = 0;
    while (count > 0) {
        const mesh_node *node = (const mesh_node *)mesh->nodes + stack[--count];
        far += far_children(node, place, near);
        for (int j = 0; j < SLOTS; j++) {
            if (!near[j] || node->low[0][j] > node->high[0][j]) continue;
            if (node->child[j] >= 0) stack[count++] = node->child[j];
            else add_solid_angles((const triangles *)mesh->leaves + ~node->child[j], q, &sum);
        }
    }
    return (far + 2.0 * whole_angle(&sum)) / (4.0 * M_PI);
}

/* The height over the surface by the normal of what the closest point is on: a triangle, an edge, or a vertex. */
static double height_over(const regnf_mesh *mesh, const double *q, const closest_point *found) {
    const int64_t *face = mesh->faces + 3 * found->triangle;
    double a[3][3], place[3], share[3], normal[3];
    for (int i = 0; i < 3; i++) memcpy(a[i], mesh->vertices + 3 * face[i], sizeof a[i]);
    for (int k = 0; k < 3; k++) place[k] = q[k] + found->way[k];
    shares_of(a, place, share);
    int none = 0, corner = 0, most = 0;
    for (int i = 2; i >= 0; i--) {
        if (share[i] < ON_EDGE) none++, corner = i;
        if (share[i] >= share[most]) most = i;
    }
    memcpy(normal, none < 2 ? mesh->of_faces + 3 * found->triangle : mesh->of_vertices + 3 * face[most], sizeof normal);
    if (none == 1)
        for (int k = 0; k < 3; k++) normal[k] += mesh->of_faces[3 * mesh->across[3 * found->triangle + corner] + k];
    const double length = sqrt(dot(normal, normal));
    return -dot(found->way, normal) / (length < 1e-300 ? 1e-300 : length);
}

static double side_of(const regnf_mesh *mesh, const double *q, const closest_point *found) {
    if (mesh->of_faces != NULL) {
        const double height = height_over(mesh, q, found);
        if (fabs(height) >= DECIDED * sqrt(found->squares)) return height < 0.0 ? -1.0 : 1.0;
    }
    return winding_number(mesh, q) > mesh->inside_above ? -1.0 : 1.0;
}

/* The unit normal of a triangle, zeros where it has no area. */
static void normal_of(const regnf_mesh *mesh, int64_t triangle, double *normal) {
    double first[3], second[3];
    const int64_t *face = mesh->faces + 3 * triangle;
    for (int k = 0; k < 3; k++) {
        first[k] = mesh->vertices[3 * face[1] + k] - mesh->vertices[3 * face[0] + k];
        second[k] = mesh->vertices[3 * face[2] + k] - mesh->vertices[3 * face[0] + k];
    }
    cross(first, second, normal);
    const double length = sqrt(dot(normal, normal));
    for (int k = 0; k < 3; k++) normal[k] /= length < 1e-300 ? 1e-300 : length;
}

/* The signed distance at q, and its gradient unless it is NULL; NaN where q is not finite. */
static double mesh_distance(const regnf_mesh *mesh, const double *q, int64_t *nearby, float *gradient) {
    closest_point found;
    if (!closest_to(mesh, q, *nearby, &found)) {
        for (int k = 0; k < 3 && gradient != NULL; k++) gradient[k] = NAN;
        return NAN;
    }
    *nearby = found.triangle;
    const double distance = sqrt(found.squares), side = side_of(mesh, q, &found);
    double towards[3];
    if (distance < mesh->touching) normal_of(mesh, found.triangle, towards);
    else
        for (int k = 0; k < 3; k++) towards[k] = -found.way[k] * (side / distance);
    for (int k = 0; k < 3 && gradient != NULL; k++) gradient[k] = (float)towards[k];
    return side * distance;
}

static int mesh_distances(const void *self, const float *points, int64_t count, float *value, float *gradient) {
    int64_t nearby = -1;
    for (int64_t p = 0; p < count; p++) {
        const double q[3] = {points[3 * p], points[3 * p + 1], points[3 * p + 2]};
        value[p] = (float)mesh_distance(self, q, &nearby, gradient == NULL ? NULL : gradient + 3 * p);
    }
    return REGNF_DONE;
}

/* The same at points in float64. */
static void mesh_at(const regnf_mesh *mesh, const double *points, int64_t count, double *value, float *gradient) {
    int64_t nearby = -1;
    for (int64_t p = 0; p < count; p++)
        value[p] = mesh_distance(mesh, points + 3 * p, &nearby, gradient == NULL ? NULL : gradient + 3 * p);
}

/* Squared distances (count) to the closest points (count, 3) on triangles (count) of points (count, 3); of one that is
 * not finite NaN and the first triangle. */
static void mesh_closest(const regnf_mesh *mesh, const double *points, int64_t count, double *squares,
                         int64_t *triangle, double *closest) {
    int64_t nearby = -1;
    for (int64_t p = 0; p < count; p++, points += 3, closest += 3) {
        closest_point found = {.squares = NAN, .way = {NAN, NAN, NAN}};
        if (closest_to(mesh, points, nearby, &found)) nearby = found.triangle;
        squares[p] = found.squares;
        triangle[p] = found.triangle < 0 ? 0 : found.triangle;
        for (int k = 0; k < 3; k++) closest[k] = points[k] + found.way[k];
    }
}

/* Winding numbers (count) at points (count, 3). */
static void mesh_winding(const regnf_mesh *mesh, const double *points, int64_t count, double *number) {
    for (int64_t p = 0; p < count; p++) number[p] = winding_number(mesh, points + 3 * p);
}

#endif
