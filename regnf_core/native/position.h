/* The contraction, and sines and cosines of the position, with their derivatives. */
#ifndef REGNF_POSITION_H
#define REGNF_POSITION_H

/* Larger of two numbers; NaN when the first is. */
INLINE float larger(float a, float b) { return a < b ? b : a; }

INLINE float norm_of(float x, float y, float z) {
    const float most = larger(larger(fabsf(x), fabsf(y)), fabsf(z));
    return x != x || y != y || z != z ? NAN : most;
}

/* Points with |x|_inf >= 1 moved to (2 - 1/|x|_inf) x / |x|_inf (Barron et al. 2022). */
static void contract(plane *x) {
    for (int p = 0; p < BLOCK; p++) {
        const float m = larger(norm_of(x[0][p], x[1][p], x[2][p]), 1.0f);
        const float factor = (2.0f - 1.0f / m) / m;
        x[0][p] *= factor;
        x[1][p] *= factor;
        x[2][p] *= factor;
    }
}

/* The gradient by the point, from that by the contracted point: c g + c'(m) (x . g) sign(x_j) e_j, j the largest axis,
 * m = |x_j| and c = 2/m - 1/m^2. */
static void pull_back_contraction(const plane *x, plane *g) {
    for (int p = 0; p < BLOCK; p++) {
        const float a = fabsf(x[0][p]), b = fabsf(x[1][p]), c = fabsf(x[2][p]);
        const int first = a >= b && a >= c, second = !first && b >= c;
        const float most = norm_of(x[0][p], x[1][p], x[2][p]), m = larger(most, 1.0f);
        const float slope = most < 1.0f ? 0.0f : (2.0f / m - 2.0f) / (m * m);
        const float along = slope * (x[0][p] * g[0][p] + x[1][p] * g[1][p] + x[2][p] * g[2][p]);
        const float factor = (2.0f - 1.0f / m) / m;
        const float on_x = x[0][p] < 0.0f ? -along : along, on_y = x[1][p] < 0.0f ? -along : along;
        const float on_z = x[2][p] < 0.0f ? -along : along;
        g[0][p] = g[0][p] * factor + (first ? on_x : 0.0f);
        g[1][p] = g[1][p] * factor + (second ? on_y : 0.0f);
        g[2][p] = g[2][p] * factor + (first || second ? 0.0f : on_z);
    }
}

/* Sine and cosine of a length times a frequency. The C library takes the angles that are too large, and NaN. */
static void wave(const float *length, float frequency, float *sine, float *cosine) {
    int large = 0;
    for (int p = 0; p < BLOCK; p++) {
        const float angle = length[p] * frequency;
        const int is_large = !(fabsf(angle) <= LARGEST_ANGLE);
        sin_cos(is_large ? 0.0f : angle, &sine[p], &cosine[p]);
        large |= is_large;
    }
    for (int p = 0; large && p < BLOCK; p++) {
        const float angle = length[p] * frequency;
        if (fabsf(angle) <= LARGEST_ANGLE) continue;
        sine[p] = sinf(angle);
        cosine[p] = cosf(angle);
    }
}

static void length_along(const regnf_field *f, int direction, const plane *z, float *length) {
    const float *d = f->along + 3 * direction;
    for (int p = 0; p < BLOCK; p++) length[p] = d[0] * z[0][p] + d[1] * z[1][p] + d[2] * z[2][p];
}

/* Sines of every length times every frequency, then the cosines in the same order. */
static void encode_waves(const regnf_field *f, const plane *z, plane *out) {
    const int half = f->directions * f->degree;
    plane length;
    for (int direction = 0; direction < f->directions; direction++) {
        length_along(f, direction, z, length);
        for (int k = 0; k < f->degree; k++) {
            const int at = direction * f->degree + k;
            wave(length, f->frequencies[k], out[at], out[half + at]);
        }
    }
}

/* Adds to `gradient` (3) what comes from that by the sines and cosines. */
static void pull_back_waves(const regnf_field *f, const plane *encoded, const plane *by_encoded, plane *gradient) {
    const int half = f->directions * f->degree;
    for (int direction = 0; direction < f->directions; direction++) {
        plane by_length = {0};
        for (int k = 0; k < f->degree; k++) {
            const int at = direction * f->degree + k;
            const float *sine = encoded[at], *cosine = encoded[half + at];
            const float *by_sine = by_encoded[at], *by_cosine = by_encoded[half + at];
            for (int p = 0; p < BLOCK; p++)
                by_length[p] += f->frequencies[k] * (by_sine[p] * cosine[p] - by_cosine[p] * sine[p]);
        }
        for (int axis = 0; axis < 3; axis++) {
            const float share = f->along[3 * direction + axis];
            for (int p = 0; p < BLOCK; p++) gradient[axis][p] += share * by_length[p];
        }
    }
}

#endif
