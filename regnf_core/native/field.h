/* A field of the neus-facto kind as the evaluator reads it, and what the library offers. */
#ifndef REGNF_FIELD_H
#define REGNF_FIELD_H

#include <stdint.h>

#define REGNF_LAYOUT 9 /* changes whenever a structure below does; regnf_core/native/library.py has the same */

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

/* Distances (count) at points (count, 3) of what `self` describes, and gradients (count, 3) unless they are NULL.
 * Returns 0 (REGNF_DONE) or a fault. */
typedef int regnf_ask(const void *self, const float *points, int64_t count, float *value, float *gradient);

enum { REGNF_DONE = 0, REGNF_NO_MEMORY = 1, REGNF_NOT_FINITE = 2 };

/* For tests: exp, log(1 + x), sin and cos of numbers (count), for which = 0, 1, 2, 3. */
typedef void regnf_elementary_function(int which, const float *x, int64_t count, float *out);

/* A model of distances: factor f(turn x + shift), with the gradient factor turn^T g. */
typedef struct {
    regnf_ask *ask;
    const void *self;
    int64_t at_once; /* points that it is asked for at most */
    int32_t checked; /* 1: a value that is not finite is a fault */
    double turn[9], shift[3], factor;
} regnf_model;

typedef struct {
    int64_t count;
    const float *points, *values, *normals; /* (count, 3), (count), (count, 3) */
} regnf_samples;

/* Poses T (count): y = scale R x + t; with an offset of the surfaces, or NULL. */
typedef struct {
    int64_t count;
    double *scale, *rotation, *translation, *offset; /* (count), (count, 3, 3), (count, 3), (count) */
} regnf_poses;

/* Residuals of poses, one row each, scene samples first. */
typedef struct {
    float *values, *jacobian, *cosines; /* (rows, total), (rows, 7, total) or NULL, (rows, total) */
    uint8_t *unobserved;                /* (rows, total), or NULL: all was observed */
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

/* Values at the nodes of a regular grid, trilinear between them; beyond, the distance to the grid is added. */
typedef struct {
    int64_t counts[3];
    float low[3], high[3], spacing[3], outward; /* outward: -1 where values are negative in free space */
    const float *values;                        /* z fastest */
} regnf_voxels;

/* A block's number within the box round all blocks, z fastest, and its row; -1: the slot is empty. */
typedef struct {
    int64_t number, row;
} regnf_slot;

/* Values at the nodes of blocks on an endless lattice, trilinear between them; see voxel_blocks.h. */
typedef struct {
    int64_t edge;               /* nodes along an edge of a block */
    int64_t low[3], size[3];    /* the box round the blocks: its lowest one, and how many along each axis */
    int64_t bits;               /* there are 1 << bits slots */
    int64_t step, near;         /* the table names `near` blocks for each step^3 blocks of the box */
    float origin[3], voxel_size, outward; /* outward: -1 where values are negative in free space */
    int32_t half;               /* 1: values are float16 */
    const void *values;         /* (blocks, edge, edge, edge), z fastest; float32 where they are not float16 */
    const int64_t *blocks;      /* (blocks, 3) */
    const regnf_slot *slots;    /* a block is in the first free one from where its number is looked for */
    const int64_t *table;       /* rows of blocks: (size / step, rounded up, near) */
} regnf_blocks;

/* A triangle mesh, with coordinates within -1 and 1 about its middle, and its hierarchy; see mesh_tree.h. */
typedef struct {
    int64_t triangles;
    const double *vertices;           /* (vertices, 3) */
    const int64_t *faces;             /* (triangles, 3) */
    void *nodes, *leaves;             /* as many as mesh_nodes says; one for eight triangles */
    int32_t *order;                   /* of the triangles in the leaves, eight in each */
    double inside_above;              /* winding number of what is inside */
    double touching;                  /* distance below which a point is on the surface */
    const double *of_faces, *of_vertices; /* normals that say the side; NULL: the winding number does */
    const int64_t *across;            /* (triangles, 3): the triangle beyond the edge opposite to each corner */
} regnf_mesh;

/* Two surfaces: samples of both, and what each is asked of. */
typedef struct {
    regnf_samples scene_samples, object_samples;
    const regnf_model *scene, *object; /* NULL: the caller asks it, and gives its distances */
    const regnf_observation *seen; /* of the scene, or NULL: all of it */
    const uint8_t *hidden;         /* scene samples that nobody saw from their front, or NULL */
    float ahead;                   /* in front of the scene's samples: where the object is asked, units of the scene */
    float min_cosine;              /* of an inlier's normals */
} regnf_pair;

/* How to minimize, see regnf_core/robust/refine. */
typedef struct {
    int64_t iterations;
    const double *widths;          /* (iterations) */
    double widest;                 /* 0: the widths stay as they are */
    double low, high;              /* of the scale */
    double max_offset;
    int32_t normals, keeps_scale;
    double damping_start, damping_low, damping_high, damping_decrease, damping_increase;
    double min_damping, relative_damping, fixed_damping, max_step;
    double spread_quantile, spread_factor;
    double unobserved_width, min_observed_share, unobserved_loss, offset_prior, score_width;
} regnf_settings;

/* The iterations so far: (poses, iterations) each; NULL: they are not kept. */
typedef struct {
    double *scale, *rotation, *translation;
    float *costs, *of_scene, *of_object; /* means of |r| */
} regnf_history;

/* One set of the steps; see steps.h, minimize.h, distances.h, voxel_blocks.h, near.h, discs.h, gaussians.h and mesh.h. */
typedef struct {
    /* Where the samples of one surface are at all poses, (poses, samples, 3); and their residuals from the other one's
     * distances and gradients there. With NULL for both, its model is asked. */
    void (*places)(const regnf_pair *, const regnf_poses *, int of_object, float *places);
    int (*fill)(const regnf_pair *, const regnf_poses *, int of_object, const regnf_rows *, const float *value,
                const float *gradient);
    /* A minimization: what is given lives as long as its state, and the poses are moved. First, and after each step,
     * its next poses are filled for both surfaces, and settled: they become the present ones where they are better. */
    void *(*begin)(const regnf_pair *, regnf_poses *, const regnf_settings *, const regnf_history *);
    void (*next_places)(const void *state, int of_object, float *places);
    int (*next_fill)(void *state, int of_object, const float *value, const float *gradient);
    void (*settle)(void *state);
    void (*step)(void *state);
    void (*score)(const void *state, float *scores, float *sizes); /* (poses), and |residuals| (poses, total) */
    void (*end)(void *state);
    regnf_ask *grid, *voxels, *blocks, *mesh;
    void (*block_slots)(const int64_t *numbers, const int64_t *rows, int64_t count, int64_t bits, regnf_slot *slots);
    int64_t (*mesh_nodes)(int64_t triangles);
    int (*grow_mesh)(const regnf_mesh *);
    void (*mesh_at)(const regnf_mesh *, const double *points, int64_t count, double *value, float *gradient);
    void (*mesh_closest)(const regnf_mesh *, const double *points, int64_t count, double *squares, int64_t *triangle,
                         double *closest);
    void (*mesh_winding)(const regnf_mesh *, const double *points, int64_t count, double *number);
    int (*nearest)(const double *points, int64_t n, const double *places, int64_t m, int64_t count, double *distance,
                   int64_t *number);
    int (*nearest_to_cells)(const double *points, int64_t n, const double *low, const double *edge, int64_t cells,
                            double *distance, int64_t *number);
    void (*kernel_sums)(const float *x, const float *u, int64_t n, const float *factors, const float *weights,
                        int64_t lengths, float *out);
    void (*discs)(const float *seen, const float *normals, int64_t n, int64_t size, float radius, int64_t *nearest);
    void (*gaussian_depths)(const float *ellipses, const int32_t *boxes, int64_t n, int64_t width, int64_t height,
                            float layer, float *work, float *depths, float *colors);
} regnf_steps;

#define REGNF_JOIN(a, b) a##b
#define REGNF_NAMED(name, set) REGNF_JOIN(name, set)
#define REGNF_EVALUATE(set) REGNF_NAMED(regnf_evaluate_, set)
#define REGNF_ELEMENTARY(set) REGNF_NAMED(regnf_elementary_, set)
#define REGNF_STEPS(set) REGNF_NAMED(regnf_steps_, set)

#endif
