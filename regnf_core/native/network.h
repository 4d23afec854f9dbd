/* The layers: products with a block's planes, and softplus of 100 a over 100 between them. */
#ifndef REGNF_NETWORK_H
#define REGNF_NETWORK_H

#define BETA 100.0f
#define FLAT 20.0f /* beyond this |100 a| softplus is its asymptote to float32 */

/* out[r] = start[r] + sum over k of w[r * row_step + k * depth_step] * in[k], for `rows` rows: a constant where it is
 * called, so that the sums of two vectors of points stay in registers. start NULL: zeros. */
INLINE void product_rows(const int rows, int64_t depth, const float *w, int64_t row_step, int64_t depth_step,
                         const plane *in, const float *start, plane *out) {
    for (int at = 0; at < BLOCK; at += 2 * WIDE) {
        vector sums[ROWS][2];
        for (int r = 0; r < rows; r++) sums[r][0] = sums[r][1] = (vector){0} + (start == NULL ? 0.0f : start[r]);
        for (int64_t k = 0; k < depth; k++) {
            const vector *row = (const vector *)&in[k][at];
            const vector low = row[0], high = row[1];
            for (int r = 0; r < rows; r++) {
                const float factor = w[r * row_step + k * depth_step];
                sums[r][0] += factor * low;
                sums[r][1] += factor * high;
            }
        }
        for (int r = 0; r < rows; r++) {
            vector *target = (vector *)&out[r][at];
            target[0] = sums[r][0];
            target[1] = sums[r][1];
        }
    }
}

/* The same for at most ROWS rows. Returns how many it took. */
INLINE int64_t product(int64_t rows, int64_t depth, const float *w, int64_t row_step, int64_t depth_step,
                       const plane *in, const float *start, plane *out) {
    if (rows >= ROWS) {
        product_rows(ROWS, depth, w, row_step, depth_step, in, start, out);
        return ROWS;
    }
    if (rows >= 4) {
        product_rows(4, depth, w, row_step, depth_step, in, start, out);
        return 4;
    }
    if (rows >= 2) {
        product_rows(2, depth, w, row_step, depth_step, in, start, out);
        return 2;
    }
    product_rows(1, depth, w, row_step, depth_step, in, start, out);
    return 1;
}

/* a -> softplus, in place, and its slope; slopes NULL: not wanted. With e = exp(-|z|), z = 100 a, the value is
 * max(z, 0) + log(1 + e) over 100, the slope 1 / (1 + e) or, below zero, e / (1 + e). */
INLINE void activate(int64_t count, float *a, float *slopes) {
    for (int64_t i = 0; i < count; i++) {
        const float z = BETA * a[i], size = fabsf(z);
        const float e = exp_of(-(FLAT < size ? FLAT : size));
        if (slopes != NULL) {
            const float upper = 1.0f / (1.0f + e);
            slopes[i] = z < 0.0f ? e * upper : upper;
        }
        a[i] = (z < 0.0f ? 0.0f : a[i]) + log1p_of(e) * (1.0f / BETA);
    }
}

/* Runs the layers. With slopes, returns the gradient by what the last hidden layer is fed by its product, (widths of
 * it); without, what it returns means nothing. hidden, next: as many planes as the widest layer has. slopes: those of
 * all hidden layers but the last, one after the other. */
static plane *forward(const regnf_field *f, const plane *inputs, plane *hidden, plane *next, plane *slopes,
                      float *distance) {
    const int last = f->layers - 1;
    const float *ends = f->weights[last];
    plane own[ROWS];
    for (int p = 0; p < BLOCK; p++) distance[p] = f->biases[last][0];
    const plane *fed = inputs;
    plane *out = hidden;
    for (int layer = 0; layer < last; layer++) {
        const int64_t depth = f->widths[layer], rows = f->widths[layer + 1];
        for (int64_t done = 0; done < rows;) {
            plane *target = out + done;
            const int64_t made = product(rows - done, depth, f->weights[layer] + done * depth, depth, 1, fed,
                                         f->biases[layer] + done, target);
            plane *slope = slopes == NULL ? NULL : layer < last - 1 ? slopes + done : own;
            if (slope == NULL) activate(made * BLOCK, target[0], NULL);
            else activate(made * BLOCK, target[0], slope[0]);
            if (layer == last - 1)
                for (int64_t r = 0; r < made; r++)
                    for (int p = 0; p < BLOCK; p++) {
                        distance[p] += ends[done + r] * target[r][p];
                        if (slope != NULL) target[r][p] = ends[done + r] * slope[r][p];
                    }
            done += made;
        }
        if (slopes != NULL) slopes += rows;
        fed = out;
        out = out == hidden ? next : hidden;
    }
    return (plane *)fed;
}

/* From the gradient by the last hidden layer's product to that by the input. other: the second of the two buffers. */
static void backward(const regnf_field *f, plane *gradient, plane *other, plane *slopes, plane *by_input) {
    for (int layer = 1; layer < f->layers - 2; layer++) slopes += f->widths[layer];
    for (int layer = f->layers - 2; layer >= 0; layer--) {
        const int64_t depth = f->widths[layer + 1], rows = f->widths[layer];
        plane *out = layer == 0 ? by_input : other;
        for (int64_t done = 0; done < rows;) {
            const int64_t made =
                product(rows - done, depth, f->weights[layer] + done, 1, rows, gradient, NULL, out + done);
            if (layer > 0) {
                float *target = out[done];
                const float *slope = slopes[done];
                for (int64_t i = 0; i < made * BLOCK; i++) target[i] *= slope[i];
            }
            done += made;
        }
        if (layer > 1) slopes -= f->widths[layer - 1];
        other = gradient;
        gradient = out;
    }
}

#endif
