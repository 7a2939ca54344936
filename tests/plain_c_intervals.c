/* For Frama-C's analysis by intervals: whatever one call of the guard of LAW gets, no MV leaves its range.

   It begins with a loop in any mode whose MVs lie anywhere in their ranges, makes one call with any numbers but NaN, any
   step included, and asserts that they lie there afterwards: so for any number of calls. A NaN fails each comparison
   of the guard, which intervals do not follow; the random histories have them. */

#include "__fc_builtin.h"

#include "LAW_guard.h"

#define LARGEST 1.7976931348623157e308

volatile int choice;

static double any(void)
{
    const double x = Frama_C_double_interval(-LARGEST, LARGEST);
    return choice ? x : (choice ? 10.0 * LARGEST : -10.0 * LARGEST); /* infinite */
}

/* A step that may give anything. */
STEP

static void begun(LAW_loop *l)
{
    LAW_begin(l, CAP_MANUAL, 0);
    l->mode = choice ? CAP_AUTO : (choice ? CAP_HOLD : CAP_MANUAL);
    l->held = choice;
    l->known = choice;
    l->lost = choice;
    l->by_hand = choice;
    l->recover_after = choice;
    l->good = 0;
    for (int k = 0; k < CAP_N_MV; ++k) {
        l->mv[k] = Frama_C_double_interval(CAP_MV_LOW[k], CAP_MV_HIGH[k]);
        l->before[k] = Frama_C_double_interval(CAP_MV_LOW[k], CAP_MV_HIGH[k]);
        l->applied[k] = Frama_C_double_interval(CAP_MV_LOW[k], CAP_MV_HIGH[k]);
        l->wanted[k] = Frama_C_double_interval(CAP_MV_LOW[k], CAP_MV_HIGH[k]);
        l->law[k] = Frama_C_double_interval(CAP_MV_LOW[k], CAP_MV_HIGH[k]);
    }
}

static void kept(const LAW_loop *l)
{
    for (int k = 0; k < CAP_N_MV; ++k) {
        //@ assert mv: CAP_MV_LOW[k] <= l->mv[k] <= CAP_MV_HIGH[k];
        //@ assert before: CAP_MV_LOW[k] <= l->before[k] <= CAP_MV_HIGH[k];
        //@ assert applied: CAP_MV_LOW[k] <= l->applied[k] <= CAP_MV_HIGH[k];
        //@ assert wanted: CAP_MV_LOW[k] <= l->wanted[k] <= CAP_MV_HIGH[k];
        //@ assert law: CAP_MV_LOW[k] <= l->law[k] <= CAP_MV_HIGH[k];
    }
}

int main(void)
{
    static LAW_loop l;
    static LAW_sample s;
    double mv[CAP_N_MV];
    begun(&l);
    switch (choice) {
    case 0:
        for (int k = 0; k < CAP_N_PV; ++k) {
            s.pv[k] = any();
        }
        for (int k = 0; k < CAP_N_DV; ++k) {
            s.dv[k] = any();
        }
        for (int k = 0; k < CAP_N_MV; ++k) {
            s.mv_applied[k] = any();
        }
        s.has_mv_applied = choice;
        s.age_s = any();
        (void)LAW_scan(&l, choice ? 0 : &s);
        break;
    case 1:
        for (int k = 0; k < CAP_N_MV; ++k) {
            mv[k] = any();
        }
        (void)LAW_set_mv(&l, mv);
        break;
    case 2:
        LAW_set_mode(&l, choice ? CAP_AUTO : CAP_MANUAL);
        break;
    case 3:
        LAW_unwritten(&l);
        break;
    default:
        LAW_gap(&l, any());
        break;
    }
    kept(&l);
    return 0;
}
