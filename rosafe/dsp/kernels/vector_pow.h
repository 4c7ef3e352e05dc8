/* Powers of many numbers at once. */
#ifndef ROSAFE_POWER_H
#define ROSAFE_POWER_H

#include "vector.h"

#include <math.h>

/* x to the power of `exponent`, 0 if x < TINY. With x = 2^e m with m between sqrt(1/2) and sqrt(2), log m is a series in
 * (m - 1) / (m + 1); 2^f with f between -1/2 and 1/2 is the exponential series. Both are truncated at full precision. */
INLINE vec power(vec x, double exponent) {
    static const double LOG[] = {1. / 23, 1. / 21, 1. / 19, 1. / 17, 1. / 15, 1. / 13, 1. / 11, 1. / 9, 1. / 7, 1. / 5, 1. / 3, 1};
    static const double EXP[] = {1. / 6227020800, 1. / 479001600, 1. / 39916800, 1. / 3628800, 1. / 362880, 1. / 40320,
                                 1. / 5040, 1. / 720, 1. / 120, 1. / 24, 1. / 6, 1. / 2, 1, 1};
    const double to_integer = 0x1.8p52; /* adding it puts the nearest integer into the lowest bits */
    const lanes bits = (lanes)larger(x, all(TINY)), large = (bits & ((1L << 52) - 1)) > 0x6A09E667F3BCC;
    vec m = (vec)((bits & ((1L << 52) - 1)) | ((1023L + large) << 52));
    vec e = (vec)(((bits >> 52) - 1023 - large) + (lanes)all(to_integer)) - all(to_integer);
    vec t = (m - 1) / (m + 1), t2 = t * t, sum = all(LOG[0]);
    UNROLL for (int i = 1; i < 12; i++) sum = fused(sum, t2, all(LOG[i]));
    vec power = bounded((e + t * sum * (2 / M_LN2)) * exponent, -1000.0, 1000.0), rounded = power + to_integer;
    vec f = (power - (rounded - to_integer)) * M_LN2, result = all(EXP[0]);
    UNROLL for (int i = 1; i < 14; i++) result = fused(result, f, all(EXP[i]));
    result = (vec)((lanes)result + ((lanes)rounded << 52));
    return (vec)((lanes)result & (x >= TINY));
}

#endif
