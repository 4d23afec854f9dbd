/* A field of the neus-facto kind as the evaluator reads it, and what the library offers. */
#ifndef REGNF_FIELD_H
#define REGNF_FIELD_H

#include <stdint.h>

#define REGNF_LAYOUT 3 /* changes whenever a structure below does; regnf_core/native/library.py has the same */

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

/* Samples of one surface at poses T (poses): y = scale R x + t. */
typedef struct {
    int64_t poses, count;
    int32_t of_object;    /* 1: samples of the object, asked of the scene; 0: the other way */
    float ahead;          /* in front of the scene's samples: where the object is asked, units of the scene's frame */
    float min_cosine;     /* of an inlier's normals */
    const float *scale, *rotation, *translation; /* (poses), (poses, 3, 3), (poses, 3) */
    const float *points, *values, *normals;      /* (count, 3), (count), (count, 3) */
} regnf_samples;

/* Where residuals go: rows of `total` samples, from the `first` on. */
typedef struct {
    int64_t total, first;
    float *values, *jacobian, *cosines; /* (poses, total), (poses, 7, total), (poses, total) */
    uint8_t *unobserved;                /* (poses, total), or NULL: all was observed */
} regnf_rows;

/* A point x is in the voxel floor(x turn + shift), the last axis fastest. */
typedef struct {
    int64_t counts[3];
    const uint8_t *states;
    float turn[9], shift[3], ahead, agreement;
} regnf_observation;

/* A distance grid: a cell holds the value at the origin and the gradient of its plane. */
typedef struct {
    int64_t cells; /* along each axis */
    float low[3], high[3], edge[3];
    const float *planes;
} regnf_planes;

/* Residuals and what they weigh. */
typedef struct {
    int64_t poses, total, scene_count;
    int32_t normals, with_offset; /* whether normals count; whether an offset is the eighth unknown */
    float unobserved_width, min_cosine;
    const float *values, *cosines;         /* (poses, total) */
    const float *widths, *observed_weights; /* (poses); (poses) or NULL */
    const uint8_t *unobserved;             /* (poses, total), or NULL */
} regnf_loss;

/* One set of the steps; see steps.h, near.h and discs.h. */
typedef struct {
    void (*places)(const regnf_samples *, float *places);
    void (*residuals)(const regnf_samples *, const float *value, const float *gradient, const regnf_rows *,
                      const regnf_observation *, const uint8_t *hidden);
    void (*grid)(const regnf_planes *, const float *points, int64_t count, float *value, float *gradient);
    void (*costs)(const regnf_loss *, double *costs);
    void (*equations)(const regnf_loss *, const float *jacobian, double *H, double *b);
    int (*nearest)(const double *points, int64_t n, const double *places, int64_t m, int64_t count, double *distance,
                   int64_t *number);
    void (*kernel_sums)(const float *x, const float *u, int64_t n, const float *factors, const float *weights,
                        int64_t lengths, float *out);
    void (*discs)(const float *seen, const float *normals, int64_t n, int64_t size, float radius, int64_t *nearest);
} regnf_steps;

#define REGNF_JOIN(a, b) a##b
#define REGNF_NAMED(name, set) REGNF_JOIN(name, set)
#define REGNF_EVALUATE(set) REGNF_NAMED(regnf_evaluate_, set)
#define REGNF_ELEMENTARY(set) REGNF_NAMED(regnf_elementary_, set)
#define REGNF_STEPS(set) REGNF_NAMED(regnf_steps_, set)

#endif
