/* One block of points: what its files offer each other. They are compiled as one unit; see evaluate.c. */
#ifndef REGNF_BLOCK_H
#define REGNF_BLOCK_H

#include <stddef.h>
#include <stdint.h>

#include "field.h"

/* WIDE: numbers in a vector register · ROWS: rows of a matrix that are multiplied at once, so many that their sums for
 * two registers of points stay in registers. */
#if defined(__AVX512F__)
#define WIDE 16
#define ROWS 8
#elif defined(__AVX__)
#define WIDE 8
#define ROWS 6
#else
#define WIDE 4
#define ROWS 4
#endif
#ifndef BLOCK
#define BLOCK 32
#endif

typedef float plane[BLOCK] __attribute__((aligned(64)));
typedef float vector __attribute__((vector_size(4 * WIDE), may_alias));

#define INLINE static inline __attribute__((always_inline))

#include "elementary.h"
#include "network.h"
#include "position.h"
#include "grid.h"

#endif
