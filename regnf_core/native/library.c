/* What the library offers: an evaluator for each instruction set. */
#include "field.h"

#include <stddef.h>

#define OFFERED __attribute__((visibility("default")))

typedef struct {
    const char *name;
    regnf_ask *evaluate;
    regnf_elementary_function *elementary;
    const regnf_steps *steps;
    int runs; /* on this processor */
} variant;

regnf_ask regnf_evaluate_plain;
regnf_elementary_function regnf_elementary_plain;
extern const regnf_steps regnf_steps_plain;

#if defined(__x86_64__)
#define VARIANTS 3
regnf_ask regnf_evaluate_avx2, regnf_evaluate_avx512;
regnf_elementary_function regnf_elementary_avx2, regnf_elementary_avx512;
extern const regnf_steps regnf_steps_avx2, regnf_steps_avx512;

static void list_variants(variant *all) {
    __builtin_cpu_init();
    const int narrow = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    const int wide = __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
                     __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl");
    all[0] = (variant){"avx512", regnf_evaluate_avx512, regnf_elementary_avx512, &regnf_steps_avx512, narrow && wide};
    all[1] = (variant){"avx2", regnf_evaluate_avx2, regnf_elementary_avx2, &regnf_steps_avx2, narrow};
    all[2] = (variant){"plain", regnf_evaluate_plain, regnf_elementary_plain, &regnf_steps_plain, 1};
}
#else
#define VARIANTS 1

static void list_variants(variant *all) {
    all[0] = (variant){"plain", regnf_evaluate_plain, regnf_elementary_plain, &regnf_steps_plain, 1};
}
#endif

/* The number-th that this processor runs, fastest first. Returns 0 where there is none. */
static int find(int number, variant *found) {
    variant all[VARIANTS];
    list_variants(all);
    for (int i = 0; i < VARIANTS; i++) {
        if (!all[i].runs || number-- != 0) continue;
        *found = all[i];
        return 1;
    }
    return 0;
}

OFFERED int regnf_layout(void) { return REGNF_LAYOUT; }

/* A digest of the files that the library was made of. */
OFFERED const char *regnf_sources(void) { return REGNF_SOURCES; }

/* The name of the number-th evaluator that this processor runs, fastest first; NULL where there is none. */
OFFERED const char *regnf_variant(int number) {
    variant found;
    return find(number, &found) ? found.name : NULL;
}

/* Its functions. */
OFFERED regnf_ask *regnf_evaluator(int number) {
    variant found;
    return find(number, &found) ? found.evaluate : NULL;
}

OFFERED regnf_elementary_function *regnf_elementary(int number) {
    variant found;
    return find(number, &found) ? found.elementary : NULL;
}

OFFERED const regnf_steps *regnf_steps_of(int number) {
    variant found;
    return find(number, &found) ? found.steps : NULL;
}
