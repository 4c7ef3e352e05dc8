/* Weights of a mixture by expectation maximization, in single precision (rosafe/localization/mixture.py).
 *
 * Each iteration reads the likelihoods once. Rounding depends on the order of summation only: not on the processor. */
#include "vector.h"

enum { WIDTH = 8, VECTORS = 9, COMPONENTS = WIDTH * VECTORS };

typedef float floats __attribute__((vector_size(4 * WIDTH)));
typedef float floats_anywhere __attribute__((vector_size(4 * WIDTH), aligned(4), may_alias));

static inline float sum_of(floats x) {
    return ((x[0] + x[4]) + (x[1] + x[5])) + ((x[2] + x[6]) + (x[3] + x[7]));
}

/* likelihood is (units, COMPONENTS); weights has the weight of the outliers at its end. inverse (units,) becomes one over the
 * likelihood of the mixture before the last iteration. */
void rosafe_mixture(int64_t units, const float *likelihood, int64_t iterations, float *weights, float *inverse) {
    floats weight[VECTORS];
    float outlier = weights[COMPONENTS];
    UNROLL
    for (int v = 0; v < VECTORS; v++) weight[v] = *(const floats_anywhere *)(weights + v * WIDTH);
    for (int64_t iteration = 0; iteration < iterations; iteration++) {
        floats sums[VECTORS] = {};
        float outliers = 0, all;
        for (int64_t unit = 0; unit < units; unit++) {
            const floats_anywhere *row = (const floats_anywhere *)(likelihood + unit * COMPONENTS);
            floats product = row[0] * weight[0];
            UNROLL
            for (int v = 1; v < VECTORS; v++) product += row[v] * weight[v];
            const float one = 1 / (sum_of(product) + outlier);
            UNROLL
            for (int v = 0; v < VECTORS; v++) sums[v] += one * row[v];
            outliers += inverse[unit] = one;
        }
        floats every = {};
        outlier *= outliers;
        UNROLL
        for (int v = 0; v < VECTORS; v++) every += weight[v] *= sums[v];
        all = sum_of(every) + outlier;
        UNROLL
        for (int v = 0; v < VECTORS; v++) weight[v] /= all;
        outlier /= all;
    }
    UNROLL
    for (int v = 0; v < VECTORS; v++) *(floats_anywhere *)(weights + v * WIDTH) = weight[v];
    weights[COMPONENTS] = outlier;
}
