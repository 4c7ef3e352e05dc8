/* What all kernels of frames take first: samples, and where the frames over them lie. */
#ifndef ROSAFE_FRAMED_H
#define ROSAFE_FRAMED_H

#include "vector.h"

#include <string.h>

/* The samples of each row are the `held` ones of the history and the n of the block behind them; they are counted from the
 * first one on. Made by `FrameReader.packed` of rosafe/dsp/kernels/__init__.py. */
typedef struct {
    const double *history;
    int64_t history_stride; /* from a row to the next */
    int64_t held;
    const double *block;
    int64_t n;
    double *tail; /* where the samples from tail_from on go, which are all of the block; may be where the history was */
    int64_t tail_stride, tail_from;
    int64_t rows;          /* of the block */
    int64_t skip;          /* where the first frame begins; each next one begins `hop` later */
    const double *weights; /* of the samples of a frame */
    int64_t size, hop;
    int64_t number; /* of frames; all are complete */
    int64_t position; /* of the first sample, counted from where the signal began */
} framed;

enum { CHAINS = 4 }; /* sums of a frame that do not wait for one another */
INLINE vec joined_chains(const vec sum[CHAINS]) { return (sum[0] + sum[1]) + (sum[2] + sum[3]); }

/* The first frame that reaches to sample `at` or beyond. */
INLINE int64_t first_frame(const framed *of, int64_t at) {
    const int64_t past = at - of->skip - of->size;
    return past < 0 ? 0 : past / of->hop + 1;
}

/* A row's samples of the block that are kept. */
INLINE void keep_tail(const framed *of, int64_t row) {
    memcpy(of->tail + row * of->tail_stride, of->block + row * of->n + (of->tail_from - of->held),
           (of->held + of->n - of->tail_from) * sizeof(double));
}

#endif
