/* HEAD

   Once lower_begin; then each period read the plant into a sample, call lower_scan, and write l.mv where it returns 1. */
#ifndef UPPER_GUARD_H
#define UPPER_GUARD_H

#include "lower.h"

#ifdef __cplusplus
extern "C" {
#endif

/* The MV is the operator's, the law's, the last one after a fault, or others': in SHADOW nothing is written, l.mv follows
   what is read back, and l.law is what the law would write. */
typedef enum { UPPER_MANUAL, UPPER_AUTO, UPPER_HOLD, UPPER_SHADOW } lower_mode;

/* Why a scan was not acted on; `which` is the place of the PV, DV or MV. */
typedef enum {
    UPPER_NONE,
    UPPER_NOT_READ,     /* there was no sample */
    UPPER_PV_NUMBER,    /* a PV is not finite */
    UPPER_PV_RANGE,     /* a PV lies more than 5 % of its range outside it */
    UPPER_PV_NEEDED,    /* a PV that the law cannot leave out is bad */
    UPPER_DV_NUMBER,    /* a measured disturbance is not finite */
    UPPER_READ_BACK,    /* no actuator can hold what is read back */
    UPPER_AGE,          /* the sample is older than a period */
    UPPER_MV_NOT_KNOWN, /* nobody has said where the MV stands */
    UPPER_LAW,          /* the law's result may not be used */
    UPPER_NOT_WRITTEN   /* the last command did not reach the plant */
} lower_fault;

typedef struct {
    double pv[UPPER_N_PV];
    double dv[UPPER_ROOM(UPPER_N_DV)];
    double mv_applied[UPPER_N_MV]; /* what the plant received over the last period, read back */
    int has_mv_applied;            /* 0: it cannot be read back */
    double age_s;                  /* since the PVs were measured */
} lower_sample;

typedef struct {
    double mv[UPPER_N_MV]; /* to write, where lower_scan returns 1 */
    double sp[UPPER_ROOM(UPPER_N_SP)];
    double info[UPPER_ROOM(UPPER_N_INFO)];
    lower_mode mode;
    lower_fault why;    /* of the last scan */
    int which;
    int held;           /* a fault changed the mode to HOLD */
    long recover_after; /* good samples after which HOLD returns to AUTO; 0: only the operator returns it */
    double max_gap;     /* missed periods in a row after which the law starts cold */
    int critical[UPPER_N_PV]; /* 1: the loop holds rather than leave this PV out */
    double bridge_s;          /* for so long a bad reading is predicted, by a law that reads fresh */
    double fresh[UPPER_N_PV]; /* set to 0 before a scan whose PV is no new reading, by a law that reads fresh */
    double operate[UPPER_ROOM(UPPER_N_OPERATE)]; /* by lower_set_operate */
    double ahead[UPPER_ROOM(UPPER_N_AHEAD)];     /* differences from now of set points and disturbances to come */
    /* What the loop remembers; leave it. */
    double state[UPPER_ROOM(UPPER_N_STATE)];
    double before[UPPER_N_MV];
    double applied[UPPER_N_MV];
    double wanted[UPPER_N_MV];
    double law[UPPER_N_MV];
    double pv[UPPER_N_PV];
    double gone[UPPER_N_PV];
    int bad[UPPER_N_PV];
    int shed[UPPER_N_PV];
    int read[UPPER_N_PV];
    long good;
    int known;
    int was_known; /* before the last scan */
    int lost;
    int taken; /* others had the MV until now, and no sample has told since where it stands */
    int by_hand; /* the MV is on its way to where an operator sent it */
    int hand;    /* the MV of the last scan is an operator's, in MANUAL since then */
    int is_read; /* a sample has had a read-back, sound or not */
} lower_loop;

/* Begin without a past, set points in the middle of their ranges. Nothing is written until a good sample says where the
   MV stands. */
void lower_begin(lower_loop *l, lower_mode mode, long recover_after);

/* One period; s 0: the plant cannot be read. Returns 1 where l->mv is to be written. */
int lower_scan(lower_loop *l, const lower_sample *s);

/* Before the next scan: so many periods passed without one. */
void lower_gap(lower_loop *l, double periods);

/* Before the next scan: the MV of the last one did not reach the plant. Best before lower_set_mode and lower_set_mv. */
void lower_unwritten(lower_loop *l);

/* After SHADOW nothing is written until a sound read-back, or a good sample without one, says where others left the MV. */
void lower_set_mode(lower_loop *l, lower_mode mode);

/* Each returns 0, and changes nothing, where a value is not allowed. An MV is the operator's in MANUAL only; it goes to
   where it is sent by at most its largest change a period. Where nobody knows where it stands, it begins at the next scan:
   from a read-back, or at once where there is none; a bad one ends it. */
int lower_set_sp(lower_loop *l, const double *sp);
int lower_set_mv(lower_loop *l, const double *mv);
#if UPPER_N_OPERATE > 0
int lower_set_operate(lower_loop *l, const double *operate);
#endif

/* Whether l->mv is to be written. */
int lower_writes(const lower_loop *l);

#ifdef __cplusplus
}
#endif

#endif
