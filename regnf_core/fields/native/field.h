/* A field of the neus-facto kind as the evaluator reads it, and what the library offers. */
#ifndef REGNF_FIELD_H
#define REGNF_FIELD_H

#include <stdint.h>

#define REGNF_LAYOUT 1 /* changes whenever the structure below does; regnf_core/fields/native/library.py has the same */

/* All arrays are the caller's, in one piece each, and are only read. */
typedef struct {
    int32_t layers;             /* linear layers; 2 or more */
    int32_t levels;             /* of the hash grid; 0: there is none */
    int32_t dense_levels;       /* the first ones, which are not hashed */
    int32_t features;           /* of a row of the table */
    int32_t smoothstep;         /* 1: weights are w w (3 - 2 w); 0: they are w */
    int32_t directions;         /* lengths that are encoded as sines and cosines; 0: none */
    int32_t degree;             /* frequencies of each of them */
    int32_t contraction;        /* 0: none; 1: of all; 2: of what the grid sees */
    float radius;               /* the grid covers [-radius, radius]^3 */
    const int32_t *widths;      /* (layers + 1): the input, then each layer's rows; the last is 1 */
    const float *const *weights; /* of layer i: (widths[i + 1], widths[i]) */
    const float *const *biases; /* of layer i: (widths[i + 1]) */
    const float *along;         /* (directions, 3) */
    const float *frequencies;   /* (degree) */
    const float *table;         /* (sum of entries, features) */
    const float *scales;        /* (levels): cells along an edge */
    const uint32_t *strides;    /* (3, levels): what a step along an axis adds to a row, or the factor of the hash */
    const uint32_t *entries;    /* (levels): rows; of a hashed level a power of two */
    const uint32_t *offsets;    /* (levels): first row */
} regnf_field;

/* Signed distance (count) at points (count, 3), and its gradient (count, 3) by them unless gradient is NULL.
 * Returns 0, or 1 when there is no memory. */
typedef int regnf_evaluate_function(const regnf_field *field, const float *points, int64_t count, float *distance,
                                    float *gradient);

/* For tests: exp, log(1 + x), sin and cos of numbers (count), for which = 0, 1, 2, 3. */
typedef void regnf_elementary_function(int which, const float *x, int64_t count, float *out);

#define REGNF_JOIN(a, b) a##b
#define REGNF_NAMED(name, set) REGNF_JOIN(name, set)
#define REGNF_EVALUATE(set) REGNF_NAMED(regnf_evaluate_, set)
#define REGNF_ELEMENTARY(set) REGNF_NAMED(regnf_elementary_, set)

#endif
