/* Eight triangles at once: how far a place is from them, and the solid angles that it sees them in. In double precision.
 */
#ifndef REGNF_TRIANGLES_H
#define REGNF_TRIANGLES_H

#include <math.h>

#include "block.h"

#define SLOTS 8

/* By corner and axis. Slots that are left over hold a triangle whose three corners are one place. */
typedef struct {
    double corners[3][3][SLOTS];
} triangles;

#define FLAT_TRIANGLE 1e-20 /* squared sine of an angle; below it a triangle is its edges alone */
#define ON_EDGE 1e-6        /* as in regnf_core/fields/mesh.py */

INLINE double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

INLINE void cross(const double *a, const double *b, double *out) {
    for (int k = 0; k < 3; k++) {
        const int i = (k + 1) % 3, j = (k + 2) % 3;
        out[k] = a[i] * b[j] - a[j] * b[i];
    }
}

/* From q to the closest point of a triangle, of the corners a, and the squared distance: that of the plane where q is
 * above the triangle, else of the closest edge. */
INLINE double to_triangle(const double *q, double a[3][3], double *way) {
    double edge[3][3], from[3][3], normal[3], side[3], best = INFINITY;
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < 3; k++) {
            edge[i][k] = a[(i + 1) % 3][k] - a[i][k];
            from[i][k] = q[k] - a[i][k];
        }
    cross(edge[0], edge[1], normal);
    const double size = dot(normal, normal);
    int above = size > FLAT_TRIANGLE * dot(edge[0], edge[0]) * dot(edge[1], edge[1]);
    for (int i = 0; i < 3; i++) {
        double rest[3];
        const double length = dot(edge[i], edge[i]), part = dot(from[i], edge[i]) / (length > 0.0 ? length : 1.0);
        const double share = part > 0.0 ? part < 1.0 ? part : 1.0 : 0.0;
        for (int k = 0; k < 3; k++) rest[k] = share * edge[i][k] - from[i][k];
        const double squares = dot(rest, rest);
        const int nearer = squares < best;
        for (int k = 0; k < 3; k++) way[k] = nearer ? rest[k] : way[k];
        best = nearer ? squares : best;
        cross(edge[i], from[i], side);
        above &= dot(side, normal) >= 0.0;
    }
    const double height = dot(normal, from[0]) / (size > 0.0 ? size : 1.0);
    for (int k = 0; k < 3; k++) way[k] = above ? -height * normal[k] : way[k];
    return above ? height * height * size : best;
}

static void squares_to(const triangles *t, const double *q, double *squares) {
    for (int j = 0; j < SLOTS; j++) {
        double a[3][3], way[3] = {0};
        for (int i = 0; i < 3; i++)
            for (int k = 0; k < 3; k++) a[i][k] = t->corners[i][k][j];
        squares[j] = to_triangle(q, a, way);
    }
}

/* Shares of a triangle's corners at a place on it, those of the areas opposite to them; without an area, equal. */
INLINE void shares_of(double a[3][3], const double *place, double *share) {
    double whole = 0.0;
    for (int i = 0; i < 3; i++) {
        double first[3], second[3], area[3];
        for (int k = 0; k < 3; k++) {
            first[k] = a[(i + 1) % 3][k] - place[k];
            second[k] = a[(i + 2) % 3][k] - place[k];
        }
        cross(first, second, area);
        share[i] = sqrt(dot(area, area));
        whole += share[i];
    }
    for (int i = 0; i < 3; i++) share[i] = whole > 0.0 ? share[i] / whole : 1.0 / 3.0;
}

/* Sums of angles as products of complex numbers: 2 pi turns + arg(x + i y), and arg is in (-pi, pi]. So one arc tangent
 * is enough for many angles. */
typedef struct {
    double x[SLOTS], y[SLOTS], turns[SLOTS];
} angles;

static void no_angle(angles *sum) {
    for (int j = 0; j < SLOTS; j++) sum->x[j] = 1.0, sum->y[j] = sum->turns[j] = 0.0;
}

/* Adds arg(x + i y) to the sum in slot j; 0 where both are 0. */
INLINE void add_angle(angles *sum, int j, double x, double y) {
    const double re = sum->x[j], im = sum->y[j], to_re = re * x - im * y, to_im = re * y + im * x;
    const double size = fabs(to_re) + fabs(to_im), factor = size > 0.0 ? 1.0 / size : 0.0;
    const int over = (im >= 0.0) & (y >= 0.0) & (to_im < 0.0);
    const int under = (im < 0.0) & (y < 0.0) & ((to_im > 0.0) | ((to_im == 0.0) & (to_re < 0.0)));
    sum->turns[j] += size > 0.0 ? (double)(over - under) : 0.0;
    sum->x[j] = size > 0.0 ? to_re * factor : re;
    sum->y[j] = size > 0.0 ? to_im * factor : im;
}

/* Half of each triangle's solid angle (van Oosterom and Strackee 1983), positive where its back is seen. */
static void add_solid_angles(const triangles *t, const double *q, angles *sum) {
    for (int j = 0; j < SLOTS; j++) {
        double a[3][3], length[3], normal[3];
        for (int i = 0; i < 3; i++) {
            for (int k = 0; k < 3; k++) a[i][k] = t->corners[i][k][j] - q[k];
            length[i] = sqrt(dot(a[i], a[i]));
        }
        cross(a[1], a[2], normal);
        const double bottom = length[0] * length[1] * length[2] + dot(a[0], a[1]) * length[2]
                              + dot(a[1], a[2]) * length[0] + dot(a[2], a[0]) * length[1];
        add_angle(sum, j, bottom, dot(a[0], normal));
    }
}

/* The sum over all slots. */
static double whole_angle(angles *sum) {
    for (int j = 1; j < SLOTS; j++) {
        add_angle(sum, 0, sum->x[j], sum->y[j]);
        sum->turns[0] += sum->turns[j];
    }
    return 2.0 * M_PI * sum->turns[0] + atan2(sum->y[0], sum->x[0]);
}

#endif
