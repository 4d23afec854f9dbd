/* Exponential, logarithm, sine and cosine in float32, in loops that compilers turn into vector instructions.
 *
 * The polynomials have the least largest relative error on their interval (Remez's exchange), computed in double
 * precision for this file; the error that is stated is before rounding to float32. */
#ifndef REGNF_ELEMENTARY_H
#define REGNF_ELEMENTARY_H

#include <math.h>
#include <string.h>

INLINE int32_t bits_of(float x) {
    int32_t bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
}

INLINE float float_of(int32_t bits) {
    float x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

/* exp(x) for x in [-87, 0], and NaN for NaN; relative error 2e-9. With x = (k + r) ln 2, k whole and |r| <= 1/2, it is
 * 2^k times a polynomial of r ln 2. */
INLINE float exp_of(float x) {
    const float shifter = 12582912.0f; /* 1.5 * 2^23: in a sum with it the lowest bits are the nearest whole number */
    const float shifted = x * 1.44269504088896341f + shifter;
    const float k = shifted - shifter;
    const float r = (x - k * 0.693145751953125f) - k * 1.42860682030941723e-6f; /* the first product is exact */
    float y = 0.0013836845755577087f;
    y = y * r + 0.008374815806746483f;
    y = y * r + 0.04166822507977486f;
    y = y * r + 0.16666419804096222f;
    y = y * r + 0.49999991059303284f;
    y = y * r + 1.0f;
    y = y * r + 1.0f;
    return y * float_of((int32_t)(((uint32_t)bits_of(shifted) << 23) + 0x3f800000u)); /* the product keeps NaN */
}

/* log(1 + x) for x in [0, 1]; relative error 3e-8. */
INLINE float log1p_of(float x) {
    float y = 0.0052326940931379795f;
    y = y * x - 0.02950523979961872f;
    y = y * x + 0.07822595536708832f;
    y = y * x - 0.13663245737552643f;
    y = y * x + 0.19106006622314453f;
    y = y * x - 0.2484298199415207f;
    y = y * x + 0.3331909775733948f;
    y = y * x - 0.4999949336051941f;
    y = y * x + 0.9999999403953552f;
    return y * x;
}

#define LARGEST_ANGLE 1048576.0f

/* sin(x) and cos(x) for |x| <= LARGEST_ANGLE; error 4e-9. The nearest multiple of pi / 2 is taken off in double
 * precision. */
INLINE void sin_cos(float x, float *sine, float *cosine) {
    const double shifter = 6755399441055744.0; /* 1.5 * 2^52, as above */
    const double quarters = ((double)x * 0.63661977236758134308 + shifter) - shifter;
    const float r = (float)((double)x - quarters * 1.57079632679489661923);
    const int32_t quarter = (int32_t)quarters;
    const float s = r * r;
    const float odd = r + r * s * ((-0.0001951729936990887f * s + 0.008332177996635437f) * s - 0.16666655242443085f);
    const float even =
        (1.0f - 0.5f * s) + s * s * ((2.4438451873720624e-05f * s - 0.001388736767694354f) * s + 0.04166664555668831f);
    const float first = quarter & 1 ? even : odd, second = quarter & 1 ? odd : even;
    *sine = float_of(bits_of(first) ^ (int32_t)((uint32_t)(quarter & 2) << 30));
    *cosine = float_of(bits_of(second) ^ (int32_t)((uint32_t)((quarter + 1) & 2) << 30));
}

#endif
