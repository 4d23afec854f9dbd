/* The multi-resolution hash grid (Müller et al. 2022): features of a block's points, and their derivatives. */
#ifndef REGNF_GRID_H
#define REGNF_GRID_H

typedef struct {
    uint32_t rows[8][BLOCK]; /* of the corners, x slowest */
    plane weights[3];        /* towards the upper corner */
    plane slopes[3];         /* of the weights by the point in the unit cube */
} cells;

#define LARGEST_SCALE 1e9f /* the numbers of corners in the cube have 31 bits then */

/* The lower 32 bits of a whole number in float32, as they are in 64 bits; 0 where it has no 64 bits. */
INLINE uint32_t wrapped(float whole) {
    return fabsf(whole) < 9.2e18f ? (uint32_t)(int64_t)whole : 0u;
}

/* Lower corner, weight and slope along one axis. inside: whether the corners' numbers are small and not negative. */
INLINE void locate_axis(float scale, int smooth, int inside, const float *unit, uint32_t *corner, float *weights,
                        float *slopes) {
    for (int p = 0; p < BLOCK; p++) {
        const float position = unit[p] * scale + 0.5f, whole = floorf(position), w = position - whole;
        if (inside) corner[p] = (uint32_t)(int32_t)whole;
        weights[p] = smooth ? w * w * (3.0f - 2.0f * w) : w;
        slopes[p] = smooth ? 6.0f * w * (1.0f - w) * scale : scale;
    }
    if (inside) return;
    for (int p = 0; p < BLOCK; p++) corner[p] = wrapped(floorf(unit[p] * scale + 0.5f));
}

/* Whether the sum of a corner within the cube passes a dense level's entries once at most. In double precision, since a
 * file may describe any scale. */
INLINE int passes_once(const regnf_field *f, int level) {
    const double last = floor((double)f->scales[level] + 0.5) + 1.0;
    const double steps = (double)f->strides[level] + f->strides[f->levels + level] + f->strides[2 * f->levels + level];
    return last * steps < 2.0 * f->entries[level];
}

/* Rows from what the lower corner adds along each axis, and one step more. once: of a dense level, whose sum passes its
 * entries once at most. */
INLINE void corner_rows(const regnf_field *f, int level, int dense, int once, uint32_t lower[3][BLOCK], cells *found) {
    const uint32_t entries = f->entries[level], offset = f->offsets[level];
    for (int corner = 0; corner < 8; corner++) {
        const uint32_t x = corner & 4 ? f->strides[level] : 0;
        const uint32_t y = corner & 2 ? f->strides[f->levels + level] : 0;
        const uint32_t z = corner & 1 ? f->strides[2 * f->levels + level] : 0;
        uint32_t *rows = found->rows[corner];
        for (int p = 0; p < BLOCK; p++) {
            const uint32_t a = lower[0][p] + x, b = lower[1][p] + y, c = lower[2][p] + z;
            const uint32_t sum = a + b + c;
            const uint32_t row = !dense ? (a ^ b ^ c) & (entries - 1)
                                 : !once ? sum % entries
                                         : sum - (sum >= entries ? entries : 0);
            rows[p] = row + offset;
        }
    }
}

static void locate(const regnf_field *f, int level, int inside, const plane *unit, cells *found) {
    uint32_t lower[3][BLOCK];
    const float scale = f->scales[level];
    inside &= scale < LARGEST_SCALE;
    for (int axis = 0; axis < 3; axis++) {
        const uint32_t stride = f->strides[axis * f->levels + level];
        float *weights = found->weights[axis], *slopes = found->slopes[axis];
        if (!inside) locate_axis(scale, f->smoothstep, 0, unit[axis], lower[axis], weights, slopes);
        else if (f->smoothstep) locate_axis(scale, 1, 1, unit[axis], lower[axis], weights, slopes);
        else locate_axis(scale, 0, 1, unit[axis], lower[axis], weights, slopes);
        for (int p = 0; p < BLOCK; p++) lower[axis][p] *= stride;
    }
    if (level >= f->dense_levels) corner_rows(f, level, 0, 0, lower, found);
    else if (inside && passes_once(f, level)) corner_rows(f, level, 1, 1, lower, found);
    else corner_rows(f, level, 1, 0, lower, found);
}

/* Values (8) of one feature at the corners. */
INLINE void gather(const regnf_field *f, const cells *found, int feature, plane *values) {
    const float *table = f->table + feature;
    const size_t width = (size_t)f->features;
    for (int corner = 0; corner < 8; corner++)
        for (int p = 0; p < BLOCK; p++) values[corner][p] = table[found->rows[corner][p] * width];
}

/* The same of both features of rows of two, which are moved as one. */
INLINE void gather_pair(const regnf_field *f, const cells *found, plane *first, plane *second) {
    for (int corner = 0; corner < 8; corner++) {
        float pairs[BLOCK][2] __attribute__((aligned(64)));
        for (int p = 0; p < BLOCK; p++) memcpy(pairs[p], f->table + 2 * (size_t)found->rows[corner][p], sizeof pairs[p]);
        for (int p = 0; p < BLOCK; p++) {
            first[corner][p] = pairs[p][0];
            second[corner][p] = pairs[p][1];
        }
    }
}

INLINE float between(float a, float b, float weight) { return a + weight * (b - a); }

/* The feature from its corners' values v, and its derivatives (3) unless NULL. */
INLINE void interpolate(const cells *found, const plane *v, float *feature, float *dx, float *dy, float *dz) {
    for (int p = 0; p < BLOCK; p++) {
        const float wx = found->weights[0][p], wy = found->weights[1][p], wz = found->weights[2][p];
        const float s00 = v[4][p] - v[0][p], s01 = v[5][p] - v[1][p], s10 = v[6][p] - v[2][p], s11 = v[7][p] - v[3][p];
        const float v00 = v[0][p] + wx * s00, v01 = v[1][p] + wx * s01;
        const float v10 = v[2][p] + wx * s10, v11 = v[3][p] + wx * s11;
        const float low = between(v00, v10, wy), high = between(v01, v11, wy);
        feature[p] = between(low, high, wz);
        if (dx == NULL) continue;
        dx[p] = found->slopes[0][p] * between(between(s00, s10, wy), between(s01, s11, wy), wz);
        dy[p] = found->slopes[1][p] * between(v10 - v00, v11 - v01, wz);
        dz[p] = found->slopes[2][p] * (high - low);
    }
}

INLINE void interpolate_into(const cells *found, const plane *values, plane *out, plane *slopes, int64_t at,
                             int64_t width) {
    if (slopes == NULL) interpolate(found, values, out[at], NULL, NULL, NULL);
    else interpolate(found, values, out[at], slopes[at], slopes[width + at], slopes[2 * width + at]);
}

/* Features, level by level, of what the grid sees; slopes: their derivatives (3, features) by the point in the unit
 * cube, unless NULL. */
static void encode_grid(const regnf_field *f, const plane *seen, plane *out, plane *slopes) {
    plane unit[3], values[2][8];
    cells found;
    int inside = 1;
    for (int axis = 0; axis < 3; axis++)
        for (int p = 0; p < BLOCK; p++) {
            unit[axis][p] = (seen[axis][p] + f->radius) / (2.0f * f->radius);
            inside &= unit[axis][p] >= 0.0f && unit[axis][p] <= 1.0f;
        }
    const int64_t width = (int64_t)f->levels * f->features;
    for (int level = 0; level < f->levels; level++) {
        const int64_t at = (int64_t)level * f->features;
        locate(f, level, inside, unit, &found);
        if (f->features == 2) {
            gather_pair(f, &found, values[0], values[1]);
            interpolate_into(&found, values[0], out, slopes, at, width);
            interpolate_into(&found, values[1], out, slopes, at + 1, width);
            continue;
        }
        for (int feature = 0; feature < f->features; feature++) {
            gather(f, &found, feature, values[0]);
            interpolate_into(&found, values[0], out, slopes, at + feature, width);
        }
    }
}

/* The gradient (3) by what the grid sees, from that by the features. */
static void pull_back_grid(const regnf_field *f, const plane *slopes, const plane *by_feature, plane *gradient) {
    const int64_t width = (int64_t)f->levels * f->features;
    for (int axis = 0; axis < 3; axis++) {
        plane sum = {0};
        for (int64_t i = 0; i < width; i++)
            for (int p = 0; p < BLOCK; p++) sum[p] += slopes[axis * width + i][p] * by_feature[i][p];
        for (int p = 0; p < BLOCK; p++) gradient[axis][p] = sum[p] / (2.0f * f->radius);
    }
}

#endif
