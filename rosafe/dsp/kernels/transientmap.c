/* Onset and offset maps: selection of peaks of the strengths (rosafe/representations/onset_offset_maps.py).
 *
 * Each frame of a map is the result of the whole algorithm on a window of frames around it. Peaks are found and sorted once
 * for many windows, because a window only selects some of them. The strongest peaks claim their neighbourhood in an array of
 * cells of `fuse` frames. Fragments are followed from the units of the frame only until they are known to be large enough. */
#include "vector.h"

#include <stdlib.h>
#include <string.h>

typedef struct {
    double strength;
    int64_t middle, start, stop; /* of the plateau, both included */
} peak;

static int stronger_or_earlier(const void *a, const void *b) {
    const peak *p = a, *q = b;
    if (p->strength != q->strength) return p->strength > q->strength ? -1 : 1;
    return (p->middle > q->middle) - (p->middle < q->middle);
}

/* Find the peaks among n frames of a channel, the first of which is frame `from`; return their number. */
static int64_t find_peaks(const double *strengths, const double *levels, double least_strength, double least_level,
                          int64_t from, int64_t n, peak *peaks) {
    int64_t number = 0, start = 0;
    int rising = 0;
    double plateau = 0.0;
    for (int64_t t = 0; t < n; t++) {
        double x = strengths[t] < least_strength || levels[t] < least_level ? 0.0 : strengths[t];
        if (t > 0 && x == plateau) continue;
        if (rising && x < plateau)
            peaks[number++] = (peak){plateau, from + (start + t - 1) / 2, from + start, from + t - 1};
        rising = t > 0 && x > plateau;
        plateau = x;
        start = t;
    }
    return number;
}

/* Claim `at` if no claimed peak is less than `fuse` frames away; return whether it was claimed. */
static int claim(int64_t at, int64_t fuse, int64_t *claimed) {
    int64_t cell = 1 + at / fuse;
    if (claimed[cell] >= 0 || (claimed[cell - 1] >= 0 && at - claimed[cell - 1] < fuse) ||
        (claimed[cell + 1] >= 0 && claimed[cell + 1] - at < fuse))
        return 0;
    claimed[cell] = at;
    return 1;
}

/* Return whether at least `spread` of the `alive` units (channels, width), those with that `stamp`, are connected to `unit`. */
static int is_large(int64_t unit, const int64_t *alive, int64_t stamp, int64_t channels, int64_t width, int64_t spread,
                    int64_t *visited, int64_t visit, int64_t *found) {
    int64_t number = 1;
    found[0] = unit;
    visited[unit] = visit;
    for (int64_t next = 0; next < number && number < spread; next++) {
        int64_t channel = found[next] / width, column = found[next] % width;
        for (int64_t c = most(0, channel - 1); c <= least(channels - 1, channel + 1); c++)
            for (int64_t t = most(0, column - 1); t <= least(width - 1, column + 1); t++) {
                int64_t near = c * width + t;
                if (alive[near] != stamp || visited[near] == visit || number == spread) continue;
                visited[near] = visit;
                found[number++] = near;
            }
    }
    return number == spread;
}

/* strengths and levels are (rows, n), rows `stride` apart, `channels` of them for each ear. Computes the frames `first` to
 * first + count - 1, map (rows, count), each from up to `reach` frames before it and `reach` frames after it; n is at least
 * first + count + reach. `at_once` frames share a search for peaks.
 * Buffers: peaks (channels, capacity), capacity at least half of at_once + 2 reach; number (channels); claimed
 * (2 reach / fuse + 3), if fuse is not 0; units (2, channels, 2 spread - 1), all 0; found (spread). */
void rosafe_transient_map(const double *strengths, const double *levels, int64_t stride, int64_t rows, int64_t channels,
                          int64_t first, int64_t count, int64_t reach, int64_t at_once, double least_strength,
                          double least_level, int64_t fuse, int64_t spread, peak *peaks, int64_t capacity,
                          int64_t *number, int64_t *claimed, int64_t *units, int64_t *found, double *map) {
    const int64_t width = 2 * spread - 1;
    int64_t *const alive = units, *const visited = units + channels * width;
    int64_t stamp = 0, visit = 0;
    memset(map, 0, rows * count * sizeof(double));
    for (int64_t row = 0; row < rows; row += channels) /* the first row of an ear */
        for (int64_t begin = first; begin < first + count; begin += at_once) {
            int64_t end = least(first + count, begin + at_once), from = most(0, begin - reach);
            for (int64_t c = 0; c < channels; c++) {
                int64_t place = (row + c) * stride + from;
                number[c] = find_peaks(strengths + place, levels + place, least_strength, least_level, from,
                                       end + reach - from, peaks + c * capacity);
                qsort(peaks + c * capacity, number[c], sizeof(peak), stronger_or_earlier);
            }
            for (int64_t k = begin; k < end; k++) {
                int64_t left = most(0, k - reach), right = k + reach, now = 0;
                stamp++;
                for (int64_t c = 0; c < channels; c++) {
                    if (fuse) memset(claimed, -1, (2 * reach / fuse + 3) * sizeof(int64_t));
                    for (const peak *p = peaks + c * capacity; p < peaks + c * capacity + number[c]; p++) {
                        if (p->start <= left || p->stop >= right) continue;
                        if (fuse && !claim(p->middle - left, fuse, claimed)) continue;
                        int64_t column = p->middle - k + spread - 1;
                        if (column < 0 || column >= width) continue;
                        alive[c * width + column] = stamp;
                        now += column == spread - 1;
                    }
                }
                for (int64_t c = 0; now > 0 && c < channels; c++) {
                    int64_t unit = c * width + spread - 1;
                    if (alive[unit] != stamp) continue;
                    now--;
                    if (is_large(unit, alive, stamp, channels, width, spread, visited, ++visit, found))
                        map[(row + c) * count + (k - first)] = 1.0;
                }
            }
        }
}
