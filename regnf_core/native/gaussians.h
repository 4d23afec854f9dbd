/* Depths of Gaussian splats in an image. The same as regnf_core/importing/splats/drawing.py says in arrays. */
#ifndef REGNF_GAUSSIANS_H
#define REGNF_GAUSSIANS_H

#define LEAST_ALPHA (1.0f / 64.0f) /* as in drawing.py */
#define MOST_ALPHA 0.99f
#define LAYER_REACH 3.0f

/* x, y, inverse covariance xx, xy, yy, depth, its slopes, opacity, red, green, blue */
#define ELLIPSE 12

static float alpha_at(const float *e, float dx, float dy) {
    const float alpha = e[8] * expf(-0.5f * (e[2] * dx * dx + 2.0f * e[3] * dx * dy + e[4] * dy * dy));
    return alpha < MOST_ALPHA ? alpha : MOST_ALPHA;
}

static float depth_at(const float *e, float dx, float dy) {
    const float depth = e[5] + e[6] * dx + e[7] * dy;
    return depth > 0.5f * e[5] ? depth : 0.5f * e[5];
}

/* ellipses: (n, ELLIPSE), from near to far · boxes: (n, 4), first and last + 1 of the columns, then of the rows · work:
 * (pixels, 4), zeros · depths: (pixels), zeros, 0 stays where less than half of the light is stopped · colors:
 * (pixels, 3), zeros. */
static void gaussian_depths(const float *ellipses, const int32_t *boxes, int64_t n, int64_t width, int64_t height,
                            float layer, float *work, float *depths, float *colors) {
    int64_t open = width * height;
    for (int64_t p = 0; p < width * height; p++) work[4 * p] = 1.0f; /* light left; half; weight of colors */
    for (int64_t i = 0; i < n && open > 0; i++) {
        const float *e = ellipses + ELLIPSE * i;
        for (int64_t y = boxes[4 * i + 2]; y < boxes[4 * i + 3]; y++)
            for (int64_t x = boxes[4 * i]; x < boxes[4 * i + 1]; x++) {
                float *own = work + 4 * (y * width + x);
                if (own[0] < 0.5f) continue;
                const float dx = (float)x + 0.5f - e[0], dy = (float)y + 0.5f - e[1], alpha = alpha_at(e, dx, dy);
                if (!(alpha > LEAST_ALPHA)) continue;
                for (int c = 0; c < 3; c++) colors[3 * (y * width + x) + c] += own[0] * alpha * e[9 + c];
                own[2] += own[0] * alpha;
                own[0] *= 1.0f - alpha;
                if (own[0] < 0.5f) {
                    own[1] = depth_at(e, dx, dy);
                    open--;
                }
            }
    }
    for (int64_t i = 0; i < n; i++) {
        const float *e = ellipses + ELLIPSE * i;
        for (int64_t y = boxes[4 * i + 2]; y < boxes[4 * i + 3]; y++)
            for (int64_t x = boxes[4 * i]; x < boxes[4 * i + 1]; x++) {
                float *own = work + 4 * (y * width + x);
                if (own[0] >= 0.5f) continue;
                const float dx = (float)x + 0.5f - e[0], dy = (float)y + 0.5f - e[1], depth = depth_at(e, dx, dy);
                const float off = (depth - own[1]) / layer;
                if (!(fabsf(off) < LAYER_REACH)) continue;
                const float alpha = alpha_at(e, dx, dy);
                if (!(alpha > LEAST_ALPHA)) continue;
                const float weight = alpha * expf(-0.5f * off * off);
                own[3] += weight;
                depths[y * width + x] += weight * (depth - own[1]);
            }
    }
    for (int64_t p = 0; p < width * height; p++) {
        const float *own = work + 4 * p;
        for (int c = 0; c < 3; c++) colors[3 * p + c] = own[2] > 0.0f ? colors[3 * p + c] / own[2] : 0.0f;
        depths[p] = own[0] < 0.5f && own[3] > 0.0f ? own[1] + depths[p] / own[3] : 0.0f;
    }
}

#endif
