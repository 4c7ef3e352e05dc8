/* The first argument of all framed kernels: samples, and the positions of the frames. */
#ifndef ROSAFE_FRAMED_H
#define ROSAFE_FRAMED_H

#include "vector.h"

#include <string.h>

/* The samples of each row are the `held` ones of the history, followed by the n of the block; they are counted from the first
 * one. Created by `FrameReader.packed` of rosafe/dsp/kernels/__init__.py. */
typedef struct {
    const double *history;
    int64_t history_stride; /* between rows */
    int64_t held;
    const double *block;
    int64_t n;
    double *tail; /* destination of the samples from tail_from on, all of the block; may overlap the history */
    int64_t tail_stride, tail_from;
    int64_t rows;          /* of the block */
    int64_t skip;          /* start of the first frame; each further frame starts `hop` later */
    const double *weights; /* of the samples of a frame */
    int64_t size, hop;
    int64_t number; /* of complete frames */
    int64_t position; /* of the first sample since the start of the signal */
} framed;

enum { CHAINS = 4 }; /* independent sums of a frame */
INLINE vec joined_chains(const vec sum[CHAINS]) { return (sum[0] + sum[1]) + (sum[2] + sum[3]); }

/* The first frame that contains sample `at` or a later one. */
INLINE int64_t first_frame(const framed *of, int64_t at) {
    const int64_t past = at - of->skip - of->size;
    return past < 0 ? 0 : past / of->hop + 1;
}

/* Save the tail of a row of the block. */
INLINE void keep_tail(const framed *of, int64_t row) {
    memcpy(of->tail + row * of->tail_stride, of->block + row * of->n + (of->tail_from - of->held),
           (of->held + of->n - of->tail_from) * sizeof(double));
}

#endif
