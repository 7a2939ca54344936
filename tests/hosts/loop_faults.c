/* What no vector of the kit holds, on a real controller (thiosulfate_cstr/pid: PVs C_A and T, MV T_j in 0 .. 500 K). */
#define LOOPWRIGHT_NO_MAIN
#include "embedded.h"

#define MUST(what)                                                   \
  do {                                                               \
    if (!(what)) return printf("line %d: " #what "\n", __LINE__), 1; \
  } while (0)

/* Nobody told where the MV stands: nothing may be written until the plant says so. */
static int start(Controller *c) {
  double pv[2] = {0.4, 300}, mv[1] = {200};
  Sample good_one = {pv, NULL, mv, 0.0}, no_read_back = {pv, NULL, NULL, 0.0};
  Loop l;
  MUST(loop_open(&l, c, AUTO, 2) && !loop_writes(&l));
  loop_scan(&l, NULL);
  MUST(l.mode == HOLD && !loop_writes(&l));
  loop_scan(&l, &no_read_back);
  MUST(l.mode == HOLD && l.reason[0] && !loop_writes(&l));
  loop_scan(&l, &good_one);
  MUST(loop_writes(&l) && l.mv[0] == 200); /* held: the law waits for two good samples */
  loop_unwritten(&l, "the plant cannot be written");
  MUST(!loop_writes(&l)); /* that first command never arrived */
  loop_scan(&l, &good_one);
  loop_scan(&l, NULL);
  MUST(loop_writes(&l) && l.mv[0] == 200);
  loop_close(&l);
  MUST(loop_open(&l, c, AUTO, 2));
  loop_scan(&l, &good_one);
  MUST(l.mode == AUTO && loop_writes(&l) && l.mv[0] == c->out[OUT_MV][0] && l.mv[0] != 200);
  loop_close(&l);
  MUST(loop_open(&l, c, MANUAL, 2) && loop_set(&l, MV, mv) && loop_writes(&l)); /* the operator's own */
  loop_close(&l);
  controller_cold(c);
  return 0;
}

static int faults(Loop *l) {
  double pv[2] = {0.4, 300}, mv[1] = {250}, sp[1] = {0.5}, beyond[1] = {1.5}, no_number[1] = {NAN}, before, state;
  Sample good_one = {pv, NULL, mv, 0.0};
  MUST(loop_set(l, SP, sp));
  MUST(!loop_set(l, SP, beyond) && !loop_set(l, SP, no_number) && l->sp[0] == 0.5);
  loop_scan(l, &good_one);
  MUST(l->mode == AUTO && !l->reason[0] && l->c->state[0] != 0);
  mv[0] = before = l->mv[0];
  loop_scan(l, &good_one);
  MUST(l->mv[0] != before);
  loop_unwritten(l, "the plant cannot be written");
  MUST(l->mode == HOLD && l->mv[0] == before && l->c->state[0] == 0 && !strcmp(l->reason, "the plant cannot be written"));
  for (int k = 0; k < 2; k++) {
    loop_scan(l, &good_one);
    MUST(l->mode == HOLD && l->mv[0] == before && l->reason[0]);
  }
  loop_scan(l, &good_one); /* the third good sample, as loop_open was told */
  MUST(l->mode == AUTO && !l->reason[0]);
  state = l->c->state[0];
  loop_gap(l, 3);
  MUST(l->c->state[0] == state);
  loop_gap(l, 4);
  MUST(l->c->state[0] == 0);
  loop_set_mode(l, MANUAL);
  before = l->mv[0];
  loop_unwritten(l, "the plant cannot be written");
  MUST(l->mode == MANUAL && l->mv[0] == before); /* what the operator wants is tried again */
  return 0;
}

int main(int n, char **words) {
  Controller c;
  Loop l = {0};
  int status = n == 2 && controller_open(&c, words[1]) && loop_open(&l, &c, AUTO, 3) ? start(&c) || faults(&l) : 2;
  loop_close(&l);
  controller_close(&c);
  if (!status) puts("all as it must be");
  return status;
}
