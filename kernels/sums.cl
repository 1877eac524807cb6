/* Compensated sums: each is a pair, the sum and what rounding took from it. Sums over pixels are
 * made in them throughout, so that no device needs double precision for a single-precision run.
 */

typedef struct {
    vec sum, lost;
} vec_sum;

typedef struct {
    real sum, lost;
} real_sum;

/* Knuth's two-sum: exact in any rounding to nearest. */
#define ACCUMULATE(total, value)                                            \
    do {                                                                    \
        const __typeof__((total).sum) value_ = (value), old_ = (total).sum; \
        (total).sum = old_ + value_;                                        \
        const __typeof__((total).sum) part_ = (total).sum - old_;           \
        (total).lost += (old_ - ((total).sum - part_)) + (value_ - part_);  \
    } while (0)

#define MERGE(total, other)               \
    do {                                  \
        ACCUMULATE((total), (other).sum); \
        (total).lost += (other).lost;     \
    } while (0)

INLINE real_sum sum_lanes(const vec_sum total)
{
    union {
        vec v;
        real lanes[LANES];
    } sum = {total.sum}, lost = {total.lost};
    real_sum all = {0, 0};
    UNROLL
    for (int l = 0; l < LANES; ++l) {
        const real_sum lane = {sum.lanes[l], lost.lanes[l]};
        MERGE(all, lane);
    }
    return all;
}

/* A place in local memory, in the kernel's outermost block, where a group's items meet. */
#if GROUP > 1
#define SHARED_SUMS(name) __local real_sum name[GROUP]
#else
#define SHARED_SUMS(name) __local real_sum *const name = 0
#endif

/* The sum of what the items of a group have, by halves; every item gets it. */
INLINE real_sum sum_group(real_sum own, __local real_sum *shared)
{
#if GROUP > 1
    shared[ITEM] = own;
    BARRIER;
    for (int count = GROUP / 2; count > 0; count /= 2) {
        if (ITEM < count) {
            own = shared[ITEM];
            MERGE(own, shared[ITEM + count]);
            shared[ITEM] = own;
        }
        BARRIER;
    }
    own = shared[0];
    BARRIER;
#endif
    return own;
}

/* Writes a pair to out[0], out[1]. */
INLINE void store_pair(__global real *out, const real_sum total)
{
    if (ITEM == 0) {
        out[0] = total.sum;
        out[1] = total.lost;
    }
}

/* This item's share of the sum of n pairs. */
INLINE real_sum sum_pairs(__global const real *pairs, const int n)
{
    real_sum all = {0, 0};
    for (int i = ITEM; i < n; i += GROUP) {
        const real_sum pair = {pairs[2 * i], pairs[2 * i + 1]};
        MERGE(all, pair);
    }
    return all;
}
