/* Pictures of oriented points: which disc is nearest to the viewer in each pixel. The same as regnf_core/viewing/splats.py
 * says in arrays. */
#ifndef REGNF_DISCS_H
#define REGNF_DISCS_H

#define LEAST_SLANT 0.12f   /* as in splats.py */
#define DEPTH_STEPS 256.0f

static int64_t within(float x, int64_t low, int64_t high) {
    return x <= (float)low ? low : x >= (float)high ? high : (int64_t)x;
}

/* seen: (n, 3) centers, pixels from the middle, the third towards the viewer · normals: (n, 3), towards the viewer ·
 * nearest: (size, size), -1 where there is no disc. */
static void nearest_discs(const float *seen, const float *normals, int64_t n, int64_t size, float radius,
                          int64_t *nearest) {
    const int64_t reach = (int64_t)ceilf(radius);
    float lowest = INFINITY;
    for (int64_t i = 0; i < n; i++)
        if (seen[3 * i + 2] < lowest) lowest = seen[3 * i + 2];
    lowest -= radius / LEAST_SLANT + 1.0f;
    for (int64_t p = 0; p < size * size; p++) nearest[p] = -1;
    for (int64_t i = 0; i < n; i++) {
        const float column = seen[3 * i] + 0.5f * (float)size, row = 0.5f * (float)size - seen[3 * i + 1];
        const float towards = normals[3 * i + 2] > LEAST_SLANT ? normals[3 * i + 2] : LEAST_SLANT;
        const float a = normals[3 * i] / towards, b = normals[3 * i + 1] / towards;
        const float square = 1.0f + a * a;
        if (!(row > (float)(-reach - 2) && row < (float)(size + reach + 2))) continue;
        for (int64_t y = (int64_t)floorf(row) - reach; y <= (int64_t)floorf(row) + reach; y++) {
            const float dy = row - (float)y - 0.5f, middle = -a * b * dy / square;
            const float half = middle * middle - ((1.0f + b * b) * dy * dy - radius * radius) / square;
            if (y < 0 || y >= size || !(half >= 0.0f)) continue;
            const int64_t first = within(ceilf(column + middle - sqrtf(half) - 0.5f), 0, size);
            const int64_t last = within(floorf(column + middle + sqrtf(half) - 0.5f), -1, size - 1);
            const float level = seen[3 * i + 2] - lowest - b * dy + a * (column - 0.5f);
            for (int64_t x = first; x <= last; x++) {
                const int64_t depth = (int64_t)((level - a * (float)x) * DEPTH_STEPS);
                const int64_t key = (int64_t)(((uint64_t)depth << 32) | (uint64_t)i);
                if (key > nearest[y * size + x]) nearest[y * size + x] = key;
            }
        }
    }
    for (int64_t p = 0; p < size * size; p++)
        if (nearest[p] >= 0) nearest[p] &= 0xFFFFFFFF;
}

#endif
