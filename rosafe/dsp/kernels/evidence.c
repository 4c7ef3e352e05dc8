/* Evidence for directions: look-up of cues in the tables of a direction model (rosafe/localization/direction_model.py).
 *
 * The tables have numbers of half precision, so that sums in double precision are exact, whatever their order. */
#include "vector.h"

enum { WIDTH = 8, VECTORS = 9, DIRECTIONS = WIDTH * VECTORS };

typedef float floats __attribute__((vector_size(4 * WIDTH)));
typedef float floats_anywhere __attribute__((vector_size(4 * WIDTH), aligned(4), may_alias));
typedef double doubles __attribute__((vector_size(8 * WIDTH)));
typedef double doubles_anywhere __attribute__((vector_size(8 * WIDTH), aligned(8), may_alias));

/* The argument `cues` of the functions; `CUES` in loader.py. Cues are (frames, channels), tables (rows, DIRECTIONS). */
struct cues {
    int64_t channels;
    const int64_t *itd_row, *ild_row;
    const double *level;
    const uint8_t *valid;
    const double *floor;
    const float *itd_table, *ild_table, *late_itd, *late_ild; /* the last two are (rows) */
    int64_t itd_bins, ild_bins, classes; /* rows of the tables for a class of levels, and number of classes */
};

struct rows {
    int64_t itd_row, ild_row;
    const floats_anywhere *itd, *ild;
};

/* Return the rows of both tables for a frame of a channel, by its level above the floor of the channel in steps of `step` dB. */
static inline struct rows look_up(const struct cues *cues, double step, int64_t at, int64_t channel) {
    const double steps = (cues->level[at] - cues->floor[channel]) / step;
    const int64_t last = cues->classes - 1;
    const int64_t class = steps >= last ? last : steps > 0 ? (int64_t)steps : 0;
    const int64_t itd = cues->itd_row[at] + class * cues->itd_bins, ild = cues->ild_row[at] + class * cues->ild_bins;
    return (struct rows){
        itd,
        ild,
        (const floats_anywhere *)(cues->itd_table + itd * DIRECTIONS),
        (const floats_anywhere *)(cues->ild_table + ild * DIRECTIONS),
    };
}

/* Add the evidence of `count` frames for the chosen channels, times factor, to sums (channels, DIRECTIONS). */
void rosafe_add_evidence(const struct cues *cues, double step, const int64_t *frames, int64_t count, const uint8_t *chosen,
                         double factor, double *sums) {
    for (int64_t channel = 0; channel < cues->channels; channel++) {
        doubles_anywhere *sum = (doubles_anywhere *)(sums + channel * DIRECTIONS);
        if (!chosen[channel]) continue;
        for (int64_t frame = 0; frame < count; frame++) {
            const int64_t at = frames[frame] * cues->channels + channel;
            if (!cues->valid[at]) continue;
            const struct rows rows = look_up(cues, step, at, channel);
            UNROLL
            for (int v = 0; v < VECTORS; v++) {
                const floats itd = rows.itd[v], ild = rows.ild[v];
                sum[v] += factor * (__builtin_convertvector(itd, doubles) + __builtin_convertvector(ild, doubles));
            }
        }
    }
}

/* Write the evidence (units, DIRECTIONS) of each channel with cues of each of `count` frames, relative to reverberation.
 * `factors` (2, classes of coherence) multiply the rows of the ITD and ILD of a channel and class. */
void rosafe_unit_evidence(const struct cues *cues, double step, const int64_t *frames, int64_t count, const float *factors,
                          int64_t coherence_classes, float *evidence) {
    for (int64_t frame = 0; frame < count; frame++) {
        for (int64_t channel = 0; channel < cues->channels; channel++) {
            const int64_t at = frames[frame] * cues->channels + channel;
            if (!cues->valid[at]) continue;
            const struct rows rows = look_up(cues, step, at, channel);
            const float itd = factors[rows.itd_row / (cues->classes * cues->itd_bins)];
            const float ild = factors[coherence_classes + rows.ild_row / (cues->classes * cues->ild_bins)];
            const float late_itd = cues->late_itd[rows.itd_row], late_ild = cues->late_ild[rows.ild_row];
            UNROLL
            for (int v = 0; v < VECTORS; v++, evidence += WIDTH)
                *(floats_anywhere *)evidence = itd * (rows.itd[v] - late_itd) + ild * (rows.ild[v] - late_ild);
        }
    }
}
